"""Times the kernels of gsplat (nerfstudio, 1.5.3, CUDA) on splats that `python benchmarks --save-scene` wrote: forward,
forward with backward, and each kernel by torch's profiler. Says so where there is no CUDA device or no gsplat.
"""

import argparse
import json
import statistics
from pathlib import Path
from typing import Any

import numpy as np
import torch

WARM_UP = 3
NAMES = ("means", "quats", "scales", "opacities", "colors")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE.npz")
    parser.add_argument("--repeat", type=int, default=15, metavar="R", help="timed runs [15]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results to FILE")
    options = parser.parse_args()
    missing = "" if torch.cuda.is_available() else "no CUDA device"
    try:
        import gsplat
    except ImportError:
        missing = missing or "gsplat is not installed"
    if missing:
        print(f"nothing to compare with: {missing}")
        return
    found: dict[str, Any] = {"gsplat": gsplat.__version__, "device": torch.cuda.get_device_name()}
    for scene in options.scenes:
        found[scene.stem] = bench(gsplat.rasterization, np.load(scene), options.repeat)
        print(scene.stem, json.dumps(found[scene.stem], indent=1))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def bench(rasterization: Any, scene: Any, repeat: int) -> dict[str, Any]:
    """Milliseconds, medians: of the image, and of image and gradients. kernels: of one image with gradients."""
    tensors = {name: torch.from_numpy(scene[name]).cuda().requires_grad_() for name in NAMES}
    view, K = (torch.from_numpy(scene[name]).cuda()[None] for name in ("T_cam_world", "K"))
    width, height = int(scene["width"]), int(scene["height"])
    colors = tensors["colors"]
    degree = None if colors.ndim == 2 else int(colors.shape[1] ** 0.5) - 1
    gradient = torch.randn(1, height, width, 3, device="cuda", generator=torch.Generator("cuda").manual_seed(1))

    def image() -> Any:
        return rasterization(**tensors, viewmats=view, Ks=K, width=width, height=height, sh_degree=degree)[0]

    def image_and_gradients() -> None:
        for tensor in tensors.values():
            tensor.grad = None
        image().backward(gradient)

    times = {"forward": milliseconds(image, repeat), "forward_backward": milliseconds(image_and_gradients, repeat)}
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CUDA]) as profile:
        image_and_gradients()
    kernels = {event.key: event.self_device_time_total / 1e3 for event in profile.key_averages()}
    largest = sorted(kernels.items(), key=lambda item: -item[1])[:20]
    return {**times, "kernels": {name: round(value, 4) for name, value in largest}}


def milliseconds(run: Any, repeat: int) -> float:
    """The median."""
    times = []
    for number in range(WARM_UP + repeat):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        run()
        end.record()
        end.synchronize()
        if number >= WARM_UP:
            times.append(start.elapsed_time(end))
    return statistics.median(times)


if __name__ == "__main__":
    main()
