#!/usr/bin/env bash
# Everything that wants a GPU, in as few calls as possible. What each stage tells is in OUT/STAGE.log; a stage that fails
# ends none of the others, and the exit code is the number of those that failed.
#
#   benchmarks/gpu.sh OUT DATA                     all stages; DATA holds the D-NeRF scenes bouncingballs, hook, jumpingjacks
#   benchmarks/gpu.sh OUT DATA kernels passes      some of them
#   SMALL=1 benchmarks/gpu.sh OUT DATA             at sizes for Mesa's software driver, which shows that the script works
#
# kernels   the kernel tests on this driver
# resident  whether the step that stays on the device is right on this driver, and what it takes, in two minutes
# passes    the passes of rasteriser, encoder, losses and a whole step: OUT/passes.json
# gsplat    the same splats drawn by gsplat's kernels, where CUDA and gsplat are installed: OUT/gsplat.json
# train     the three scenes at 800x800 by the whole schedule of dnerf, grid4d and laplacian: OUT/table. HOURS=H stops it
#           in time, with saved state; the same call goes on
set -uo pipefail
out=$(realpath -m "$1") data=$(realpath "$2")
shift 2
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
mkdir -p "$out"
limit=${HOURS:+timeout ${HOURS}h}
if [ -n "${SMALL:-}" ]; then
  scenes=(2k@96x96) repeat=2 parts=(raster encoder losses) tests=(tests/test_scan.py tests/test_radix_sort.py)
  table=$out/small.toml
  sed 's/^\[common\]/&\nschedule.steps = 30\npoints.count = 500\ndata.size = 48\ndiscovery.enabled = false/' benchmarks/gpu.toml > "$table"
else
  scenes=(50k@400x400 100k@800x800 500k@800x800) repeat=15 parts=(raster encoder losses step) tests=(tests)
  table=benchmarks/gpu.toml
fi

kernels() { $python -m pytest -m kernels "${tests[@]}"; }

passes() {
  $python -c 'from lapgs_wgpu.command import print_devices; print_devices()' &&
    $python benchmarks --scenes "${scenes[@]}" --parts "${parts[@]}" --repeat "$repeat" --json "$out/passes.json"
}

resident() {
  $python -m pytest -q tests/test_resident_step.py && $python benchmarks --parts steps host --repeat 30
}

gsplat() {
  local files=()
  for scene in "${scenes[@]}"; do
    $python benchmarks --scenes "$scene" --save-scene "$out/$scene.npz" || return
    files+=("$out/$scene.npz")
  done
  $python benchmarks/gsplat_passes.py "${files[@]}" --repeat "$repeat" --json "$out/gsplat.json"
}

# shellcheck disable=SC2086 # two words, or none
train() { $limit $python benchmarks/run_table.py "$table" --data "$data" --out "$out/table"; }

failed=0
for stage in "${@:-resident kernels passes gsplat train}"; do
  for name in $stage; do
    start=$SECONDS
    "$name" > "$out/$name.log" 2>&1
    code=$?
    [ $code = 0 ] || failed=$((failed + 1))
    echo "$name: exit code $code, $((SECONDS - start)) s: $(tail -n 1 "$out/$name.log")"
  done
done
exit $failed
