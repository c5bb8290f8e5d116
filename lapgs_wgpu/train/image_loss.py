"""The image losses and their gradient on the device.

The order of the passes is that of `ImageLoss.record`; docs/architecture.md lists them. Nothing here waits for the
device.
"""

import functools

import numpy as np

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.train.config import LossWeights

TERMS = 5  # in the buffer that `record` leaves
PYRAMID_BANDS = 3  # band-pass levels; below them lies the residual
DIVISIBLE = 3  # pixels of a level's shorter side, which reflection needs
NCC_WINDOW = 11


def pyramid_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """(height, width) of each level, the finest first, the residual last: halves, rounded up.

    A level is only divided further where reflection has the pixels it needs: small images have fewer band-pass levels,
    and for those that cannot be divided at all the loss is 0.
    """
    sizes = [(height, width)]
    while len(sizes) <= PYRAMID_BANDS and min(sizes[-1]) >= DIVISIBLE:
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    return sizes


def pyramid_weights(levels: int) -> list[float]:
    """Of each level, the finest first: 2^-(l - 1), divided by their sum."""
    weights = [2.0**-level for level in range(levels)]
    return [weight / sum(weights) for weight in weights]


class ImageLoss:
    """Records the passes that compare images with their ground truth. Keeps its buffers from image to image.

    An image may have as many pixels as fit into one binding at 48 bytes each (2.8 million at WebGPU's default limit,
    128 MiB) where SSIM is used, else at 16 bytes.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.pool = BufferPool(device)
        # On CPUs a workgroup is one vector that walks a whole row or column (in several runs, if it is longer than
        # 16,384 pixels); GPUs need more lanes than that makes.
        self._lanes, self._run = (8, 1 << 14) if device.is_cpu else (64, 64)

    def record(
        self, commands: Commands, image: DeviceArray, truth: DeviceArray, weights: LossWeights
    ) -> tuple[DeviceArray, DeviceArray]:
        """Compare an image with its ground truth.

        Returns terms (5,) float32: L1, mean squared error, 1 - SSIM, pyramid, NCC; the last three 0 where their weight
        is 0; and the weighted loss's gradient (4, H, W) float32 by red, green, blue, and zeros.

        image: planes (4, H, W) of float32, the first three red, green, blue. truth: (H, W) uint32, RGBA of 8 bits, red
        lowest; pixels of alpha 0 are left out. weights: of the terms.
        """
        height, width = truth.shape
        frame = _Frame(self, commands, height, width, weights)
        held = self.held(truth)
        if held.buffer is not truth.buffer:
            commands.copy(truth, held)
        frame.pixels(image, held)
        if weights.ssim:
            frame.ssim()
        if frame.ncc_windows:
            frame.ncc()
        if frame.sizes:
            frame.pyramid()
        return frame.sum_up(), frame.gradient()

    def held(self, truth: DeviceArray) -> DeviceArray:
        """Where a ground truth (H, W) is copied to: all of a training go through one buffer, texture and bind group."""
        return self.pool.array("truth", truth.shape, "uint32")


image_loss_of = functools.cache(ImageLoss)  # that of a device, whose buffers serve all images


class _Frame:
    """The passes of an image. ncc_windows, sizes: 0 and empty without the loss. arrays: that several passes bind, by
    the names of the bindings; ssim, ncc and pyramid are what these losses leave for the gradient."""

    def __init__(self, owner: ImageLoss, commands: Commands, height: int, width: int, weights: LossWeights) -> None:
        self.device, self.pool, self.lanes, self.length = owner.device, owner.pool, owner._lanes, owner._run
        self.commands, self.height, self.width, self.weights = commands, height, width, weights
        # With what fills up strips of 8 columns, or of 8 rows: common/picture.wgsl.
        self.places, self.places_across = (width + 7) // 8 * 8 * height, (height + 7) // 8 * 8 * width
        margin = NCC_WINDOW - 1
        self.ncc_windows = max(height - margin, 0) * max(width - margin, 0) if weights.ncc else 0
        self.sizes = pyramid_sizes(height, width) if weights.pyramid and min(height, width) >= DIVISIBLE else []

        # How many lanes leave partial sums, a term after the other.
        rows = self.runs(width) * height
        counts = [height * self.lanes, height * self.lanes, 3 * rows if weights.ssim else 0]
        self.pyramid_counts = [self.runs(h) * w for h, w in self.sizes[1:]]
        counts += [sum(self.pyramid_counts), self.runs(width) * (height - margin) if self.ncc_windows else 0]
        self.ends = np.cumsum(counts).tolist()

        pixel = 1.0 / (3 * height * width)
        window = 1.0 / max(1, self.ncc_windows)
        slope = weights.l1 * pixel, weights.ssim * pixel, weights.ncc * (window / NCC_WINDOW**2), 0.0
        given = {"size": (width, height), "run": self.length, "slope": slope}
        given |= {"ssim_first": self.ends[1], "ncc_first": self.ends[3], "value": (pixel, pixel, window, 0.0)}
        picture = self.pool.varying("picture", lambda: self.kernel("loss_pixels").uniform("Picture", **given))
        self.arrays = {"picture": picture, "sums": self.pool.array("sums", (self.ends[-1],))}

    def runs(self, length: int) -> int:
        return -(-length // self.length)

    def grid(self, lanes: int, length: int, channels: int = 1) -> tuple[int, int]:
        """Workgroups for so many lanes, each of which takes a run of the length."""
        return -(-lanes // self.lanes), channels * self.runs(length)

    def kernel(self, name: str, **defines: bool) -> Kernel:
        return Kernel.get(self.device, name, LANES=self.lanes, **defines)

    def run(self, name: str, grid: tuple[int, int], arrays: dict[str, DeviceArray], **defines: bool) -> None:
        """Record a pass with those of the image's arrays, and of these further ones, that it binds."""
        kernel, arrays = self.kernel(name, **defines), self.arrays | arrays
        self.commands.dispatch_grid(kernel, grid, **{binding: arrays[binding] for binding in kernel.bindings})

    def pixels(self, image: DeviceArray, rgba: DeviceArray) -> None:
        self.arrays |= {"image": image, "pixels": self.pool.array("pixels", (self.places, 4), "uint32")}
        self.run("loss_pixels", (1, self.height), {"rgba": rgba})

    def ssim(self) -> None:
        """By the blurs; leaves their slopes blurred along the rows."""
        moments = self.pool.array("ssim moments", (3, self.places_across, 4))
        slopes = self.arrays["ssim"] = self.pool.array("ssim slopes", (3, self.places, 4))
        self.run("loss_ssim_down", self.grid(self.width, self.height, channels=3), {"moments": moments})
        across = self.grid(self.height, self.width, channels=3)
        self.run("loss_ssim_across", across, {"moments": moments, "slopes": slopes})

    def ncc(self) -> None:
        """By the luminance. moments: of pixels below each other; slopes: the derivatives, summed along the rows."""
        rows = self.height - NCC_WINDOW + 1
        arrays = {name: self.pool.array(f"ncc {name}", (self.places, 4)) for name in ("moments", "slopes")}
        arrays["truth_variances"] = self.pool.array("ncc truth variances", (self.places,))
        self.arrays["ncc"] = arrays["d_luminance"] = self.pool.array("d_luminance", (self.places,))
        self.run("loss_ncc_down", self.grid(self.width, rows), arrays)
        self.run("loss_ncc_across", self.grid(rows, self.width), arrays)
        self.run("loss_ncc_up", self.grid(self.width, self.height), arrays)

    def pyramid(self) -> None:
        """By the difference: down to the residual, and from there up."""
        bands = len(self.sizes) - 1
        weights = zip(pyramid_weights(bands + 1), self.sizes, strict=True)
        shares = [weight / (3 * height * width) for weight, (height, width) in weights]
        first, levels = self.ends[2], list[tuple[DeviceArray, DeviceArray]]()  # uniform and signs of each
        fine = self.arrays["pixels"]
        for k in range(bands):
            (fine_height, fine_width), (height, width) = self.sizes[k : k + 2]
            sizes = {"fine": (fine_width, fine_height), "coarse": (width, height)}
            values = {"value": shares[k], "coarse_value": shares[k + 1]}
            slopes = {"slope": shares[k] * self.weights.pyramid, "coarse_slope": shares[k + 1] * self.weights.pyramid}
            kernel = self.kernel("loss_pyramid_band", FINEST=k == 0, RESIDUAL=k == bands - 1)
            content = kernel.uniform("Level", run=self.length, first=first, **sizes, **values, **slopes)
            signs = self.pool.array(f"signs {k}", (fine_height, fine_width), "uint32")
            level, coarse = self.pool.constant(content), self.pool.array(f"level {k + 1}", (height, width, 4))
            arrays = {"level": level, "signs": signs, "fine": fine, "coarse": coarse}
            self.run("loss_pyramid_reduce", (-(-width // self.lanes), height), arrays, FINEST=k == 0)
            self.run("loss_pyramid_band", self.grid(width, height), arrays, FINEST=k == 0, RESIDUAL=k == bands - 1)
            levels.append((level, signs))
            first += self.pyramid_counts[k]
            fine = coarse
        arrays = {"difference": fine}  # the residual
        for k in range(bands, 0, -1):
            height, width = self.sizes[k]
            arrays["d_level"] = self.pool.array(f"d_level {k}", (height, width, 4))
            arrays["above"], arrays["fine_signs"] = levels[k - 1]
            if k < bands:
                arrays["below"], arrays["signs"] = levels[k]
            self.run("loss_pyramid_bwd", (-(-width // self.lanes), height), arrays, RESIDUAL=k == bands)
            arrays["d_coarse"] = arrays["d_level"]
        self.arrays["pyramid"] = arrays["d_difference"] = self.pool.array("d_difference", (self.places, 4))
        arrays["level"], arrays["signs"] = levels[0]
        height, width = self.sizes[1]
        self.run("loss_pyramid_finest", (-(-width // self.lanes), height), arrays, FINEST=True)

    def sum_up(self) -> DeviceArray:
        """The terms."""
        names = ("l1", "squared", "ssim", "pyramid", "ncc")
        ends = dict(zip(names, zip([0, *self.ends], self.ends, strict=False), strict=True))
        parts = self.pool.constant(self.kernel("loss_sums").uniform("Parts", **ends))
        terms = self.pool.array("terms", (TERMS,))
        self.run("loss_sums", (TERMS, 1), {"parts": parts, "terms": terms})
        return terms

    def gradient(self) -> DeviceArray:
        """By the image."""
        d_image = self.pool.array("d_image", (4, self.height, self.width))
        flags = {name.upper(): name in self.arrays for name in ("ssim", "ncc", "pyramid")}
        self.run("loss_gradient", self.grid(self.width, self.height, channels=3), {"d_image": d_image}, **flags)
        return d_image
