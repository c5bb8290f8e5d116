# Everything lives in .venv; `make` or `make setup` makes it, and the other goals call that first.
#   make demo   trains the built-in scene         make test   tests        make lint   ruff and mypy
#   make test-all  all tests, with all kernels in every configuration of the device (CI: every night)
#   make test-swiftshader  all kernel tests on a second Vulkan driver, SwiftShader, which comes with Chromium
#   make soak   what takes hours: 10,000 hostile files a format, failing disks, 20 kills, large scenes, 30 minutes of training
#   make docs   the site of docs/ in build/site     make pictures   the pictures of README and docs/, from a trained demo
#   make bench  times the kernels, beside what the device can do; options go into ARGS, for example:
#               make bench ARGS="--scenes 50k@400x400 --parts raster --json new.json"

BIN := .venv/bin
READY := .venv/.ready
PYTEST = $(BIN)/pytest
PARALLEL = $(PYTEST) -n auto --dist loadfile
export XDG_RUNTIME_DIR ?= /tmp

.PHONY: setup demo test test-all test-swiftshader soak bench lint pictures docs
setup: $(READY)

# torch first: where there is no CUDA device, by exact version, so that an index with CPU builds can offer its own
# ("2.13.0+cpu" counts as 2.13.0). A torch that is already in .venv stays.
$(READY): pyproject.toml | $(BIN)/pip
	@$(BIN)/python -c 'import torch' 2>/dev/null || \
	  if [ -e /dev/nvidia0 ] || [ "$$(uname)" = Darwin ]; then $(BIN)/pip install torch; \
	  else $(BIN)/pip install torch==2.13.0; fi
	@echo "Installing lapgs_wgpu into .venv"
	@$(BIN)/pip install --quiet --editable '.[dev]'
	@$(HAS_ADAPTER) || { $(INSTALL_MESA) && $(HAS_ADAPTER); } || { echo "$$NO_ADAPTER" >&2; exit 1; }
	@touch $@

$(BIN)/pip:
	@for python in $(PYTHON) python3 python3.11 python3.12 python3.13 python3.14; do \
	  $$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && break; python=; \
	done; \
	[ "$$python" ] || { echo "$$NO_PYTHON" >&2; exit 1; }; \
	$$python -c 'import ensurepip' 2>/dev/null || { echo "$$NO_VENV" >&2; exit 1; }; \
	$$python -m venv .venv

HAS_ADAPTER = $(BIN)/python -c 'from lapgs_wgpu import list_devices; raise SystemExit(not list_devices())'
# The last two are of the viewer's GUI, which does not bring them.
MESA = apt-get install -y mesa-vulkan-drivers libvulkan1 libx11-6 libxext6
INSTALL_MESA = { echo "No Vulkan adapter: installing Mesa's software driver"; command -v apt-get >/dev/null && \
  if [ "$$(id -u)" = 0 ]; then $(MESA) || { apt-get update && $(MESA); }; \
  else sudo $(MESA) || { sudo apt-get update && sudo $(MESA); }; fi; }
export NO_ADAPTER = No Vulkan, Metal or D3D12 adapter was found. Install your graphics card's driver, or Mesa's software\
  driver, and run make again. On Debian and Ubuntu: sudo apt-get update && sudo $(MESA)
export NO_PYTHON = Python 3.11 or newer was not found. Install it, or name one: make setup PYTHON=/path/to/python3
export NO_VENV = This Python cannot make virtual environments. On Debian and Ubuntu: sudo apt-get install -y python3-venv

demo: $(READY)
	$(BIN)/lapgs-train demo --data synthetic --out runs/demo --overwrite
	@echo "Pictures of the test views: runs/demo/eval/*.png (ground truth, rendering, 4 x error)."
	@echo "The scene: runs/demo/checkpoint.ply. To look at it from any side at any time, and to send it to somebody:"
	@echo "  $(BIN)/lapgs-view runs/demo/checkpoint.ply --time-slider"
	@echo "  $(BIN)/lapgs-view runs/demo/checkpoint.ply --export runs/demo/scene.html"

# docs/reliability.md says what each promises. LAPGS_SOAK_MINUTES and LAPGS_FUZZ may be given.
LAPGS_SOAK_MINUTES ?= 30
LAPGS_FUZZ ?= 10000
soak: $(READY)
	LAPGS_FUZZ=$(LAPGS_FUZZ) $(PYTEST) tests/test_hostile_files.py tests/test_hostile_captures.py \
	  tests/test_hostile_pages.py tests/test_full_disks.py
	LAPGS_SOAK_KILLS=20 $(PYTEST) tests/test_resume.py
	LAPGS_SOAK=1 $(PYTEST) tests/test_scale.py
	LAPGS_SOAK=1 $(PYTEST) tests/test_web_player.py -k trained_scene
	LAPGS_SOAK_MINUTES=$(LAPGS_SOAK_MINUTES) $(PYTEST) tests/soak

bench: $(READY)
	$(BIN)/python benchmarks $(ARGS)

# Of `make demo`, which is trained first where runs/demo is not there; then discovery is run once more.
pictures: $(READY)
	[ -e runs/demo/checkpoint.ply ] || $(MAKE) demo
	$(BIN)/python docs/tools/pictures.py runs/demo docs/pictures

docs: $(READY)
	@$(BIN)/python -c 'import mkdocs, material, mkdocstrings' 2>/dev/null || $(BIN)/pip install --quiet --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict  # mkdocs is held below 2 (pyproject.toml)

lint: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# What the kernels compute must not depend on the device's shape: `test-all` runs them in every configuration of
# tests/conftest.py, and on Mesa's software driver at each vector width (its shader cache ignores the width). `test`
# leaves that to it, and the tests marked `nightly`. Each processor runs the modules of one worker.
LLVMPIPE = $(shell $(BIN)/python -c 'from lapgs_wgpu import list_devices; print("llvmpipe" in list_devices()[0].name)')
kernels = echo "== kernel tests, $(1)"; LAPGS_TEST_DEVICE=$(1) $(PARALLEL) -m kernels

test: $(READY)
	@$(PARALLEL) -m "not nightly"

test-all: $(READY)
	@for name in gpu no-subgroups default-limits gpu-shape; do $(call kernels,$$name) || exit 1; done
	@for width in $(if $(filter True,$(LLVMPIPE)),128 256 512); do echo "== kernel tests, vectors of $$width bits"; \
	  LP_NATIVE_VECTOR_WIDTH=$$width MESA_SHADER_CACHE_DISABLE=true $(PARALLEL) -m kernels || exit 1; done
	@echo "== all tests"
	@$(PARALLEL)

# Debian's package has the driver's description; other builds of Chromium name it alike.
SWIFTSHADER ?= /usr/lib/chromium/vk_swiftshader_icd.json
test-swiftshader: $(READY)
	@[ -e $(SWIFTSHADER) ] || { echo "$(SWIFTSHADER) is not there: apt-get install chromium, or name another with\
	 SWIFTSHADER=FILE" >&2; exit 1; }
	@echo "== kernels tests, SwiftShader"
	@VK_DRIVER_FILES=$(SWIFTSHADER) VK_ICD_FILENAMES=$(SWIFTSHADER) $(PYTEST) -m kernels
