"""The passes of the resident step that no gradient test covers, each against torch in float64."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import sampled_rows
from helpers.matrices import on_device, random, read
from helpers.scenes import relative
from torch import Tensor, nn

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.matmul import sum_columns
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.dynamics import dynamics_loss
from lapgs_wgpu.motion.fields.laplacian import VARIANCE_FLOOR, VARIANCE_SPREAD, LaplacianMotion
from lapgs_wgpu.motion.passes.samples import SamplePasses, Samples
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import MEAN, RADIUS, SPLAT_FLOATS
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterizer import Rasterizer
from lapgs_wgpu.train.camera_refinement import CameraRefinement, scene_points
from lapgs_wgpu.train.config import CamerasConfig, Rate
from lapgs_wgpu.train.densify import Statistics
from lapgs_wgpu.train.exposure import Exposures
from lapgs_wgpu.train.optimizer import ADAM_EPS, LARGEST_FREQUENCY_STEP, FrequencyOptimizer
from lapgs_wgpu.train.resident_corrections import ResidentCorrections
from lapgs_wgpu.train.resident_parameters import check_finite

pytestmark = pytest.mark.kernels
OPEN, CLOSED = 0, 7


def word(device: Device, value: int) -> DeviceArray:
    return DeviceArray.upload(device, "word", np.array([value], np.uint32))


def uniform(device: Device, kernel: Kernel, struct: str, **values: object) -> DeviceArray:
    return DeviceArray.upload(device, struct, np.frombuffer(kernel.uniform(struct, **values), np.uint8))


@pytest.mark.parametrize("guard", [OPEN, CLOSED])
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (301, 3)])
def test_adam(device: Device, rows: int, columns: int, guard: int) -> None:
    """Steps with a rate for each column, as torch.optim.Adam takes them; behind a closed guard nothing moves."""
    rates, values = [10.0**-k for k in range(columns)], random(rows, columns)
    exact = [nn.Parameter(values[:, k].double()) for k in range(columns)]
    adam = torch.optim.Adam([{"params": [p], "lr": rate} for p, rate in zip(exact, rates, strict=True)], eps=ADAM_EPS)
    kernel = Kernel.get(device, "adam")
    arrays = [on_device(device, each) for each in (values, torch.zeros_like(values), torch.zeros_like(values))]
    given = uniform(device, kernel, "Adam", count=rows * columns, columns=columns, first=1)
    for step in range(1, 4):
        gradient = random(rows, columns, seed=step) * 10.0 ** -(3 * step)
        d = on_device(device, gradient)
        table = [(0.0, 0.0), *((rate / (1 - 0.9**step), (1 - 0.999**step) ** -0.5) for rate in rates)]
        with Commands(device) as commands:
            commands.dispatch(
                kernel, -(-rows * columns // 256), adam=given, guard=word(device, guard),
                rates=on_device(device, torch.tensor(table)), gradients=d, values=arrays[0], means=arrays[1],
                squares=arrays[2],
            )  # fmt: skip
        for k, p in enumerate(exact):
            p.grad = gradient[:, k].double()
        adam.step()
        assert not read(d).any()
    expected = torch.stack([p.detach() for p in exact], dim=1) if guard == OPEN else values.double()
    torch.testing.assert_close(read(arrays[0]).double(), expected, rtol=1e-5, atol=1e-6)


def test_adam_of_the_frequencies(device: Device) -> None:
    width, components, rate, limit = 20, 5, 3e-2, 3.5
    motion = LaplacianMotion(4, FieldConfig(width=width, components=components), torch.Generator().manual_seed(0))
    optimizer = FrequencyOptimizer(motion, Rate(rate, rate, 1), limit)
    flat = torch.cat([motion.alpha.detach().flatten(), motion.beta.detach().flatten(), motion.frequencies.detach()])
    kernel, first = Kernel.get(device, "adam_frequencies"), 2 * width * components
    weights, state = on_device(device, flat), on_device(device, torch.zeros(components + 1))
    for step in range(1, 6):
        gradient = random(components, seed=step)
        motion.frequencies.grad = gradient.clone()
        optimizer.step(step)
        given = uniform(
            device, kernel, "Frequencies", width=width, components=components, alpha=0, beta=width * components,
            frequencies=first, rate=rate / (1 - 0.9**step), square_factor=(1 - 0.999**step) ** -0.5, limit=limit,
            largest=LARGEST_FREQUENCY_STEP, floor=VARIANCE_FLOOR, spread=VARIANCE_SPREAD,
        )  # fmt: skip
        d = on_device(device, torch.cat([torch.zeros(first), gradient]))
        with Commands(device) as commands:
            commands.dispatch(
                kernel, 1, spectrum=given, guard=word(device, OPEN), d_weights=d, weights=weights, state=state
            )
        assert not read(d).any()
    torch.testing.assert_close(read(weights)[first:], motion.frequencies.detach(), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(read(weights)[:first], flat[:first])
    moments = torch.cat([optimizer.state()["mean"], optimizer.state()["square"].float()[None]])
    torch.testing.assert_close(read(state), moments, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(("count", "columns"), [(1, 3), (700, 20), (65, 1)])
def test_the_dynamics_loss(device: Device, count: int, columns: int) -> None:
    rows, weight = random(count, columns + 1), 0.3
    exact = rows[:, :columns].double().requires_grad_()
    loss = weight * dynamics_loss(exact)
    loss.backward()
    pool = BufferPool(device)
    arrays = {
        "rows": on_device(device, rows), "d_rows": on_device(device, torch.zeros(count, columns + 1)),
        "sums": pool.array("sums", (64, 256)), "distances": pool.array("distances", (count,)),
        **{name: pool.array(name, (64,)) for name in ("distance_sums", "square_sums", "losses")},
    }  # fmt: skip
    for name in ("dynamics_mean", "dynamics_distances", "dynamics_deviation", "dynamics_bwd"):
        kernel = Kernel.get(device, name, GROUPS=64)
        sizes = {"gaussians": count, "columns": columns, "stride": columns + 1, "weight": weight}
        arrays["dynamics"] = uniform(device, kernel, "Dynamics", **sizes)
        with Commands(device) as commands:
            commands.run(kernel, 64, arrays)
    totals = on_device(device, torch.zeros(3))
    with Commands(device) as commands:
        sum_columns(commands, pool, arrays["losses"], totals, place=1, factor=2.0)
    torch.testing.assert_close(
        read(totals).double(), torch.tensor([0.0, 2 * loss.item(), 0.0]).double(), rtol=1e-5, atol=1e-7
    )
    gradient = torch.zeros(count, columns + 1, dtype=torch.float64)
    gradient[:, :columns] = exact.grad
    torch.testing.assert_close(read(arrays["d_rows"]).double(), gradient, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("guard", [OPEN, CLOSED])
def test_statistics_of_density_control(device: Device, guard: int) -> None:
    count, camera = 150, SimpleNamespace(width=30, height=20)
    splats, d_splats, before = (
        random(count, SPLAT_FLOATS),
        random(count, SPLAT_FLOATS, seed=1),
        random(count, 2, seed=2).abs(),
    )
    splats[:, RADIUS] = torch.where(torch.arange(count) % 3 == 0, 0.0, 9 * splats[:, RADIUS].abs())
    expected = Statistics(*(column.clone() for column in before.T))
    if guard == OPEN:
        expected.add(splats[:, RADIUS].int(), d_splats[:, MEAN], camera)
    kernel, known = Kernel.get(device, "accumulate_statistics"), on_device(device, before)
    given = uniform(device, kernel, "Seen", half_size=(15.0, 10.0), gaussians=count)
    with Commands(device) as commands:
        commands.dispatch(
            kernel, 3, seen=given, guard=word(device, guard), splats=on_device(device, splats),
            d_splats=on_device(device, d_splats), statistics=known,
        )  # fmt: skip
    for found, wanted in zip(read(known).T, vars(expected).values(), strict=True):
        kept = splats[:, RADIUS] >= 1  # a radius below a pixel is none to torch, which has whole numbers
        torch.testing.assert_close(found[kept], wanted[kept], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("bad", "capacity", "needed", "closed"), [(0, 10, 10, 0), (4, 10, 3, 5), (0, 10, 11, 5)])
def test_the_guard_closes(device: Device, bad: int, capacity: int, needed: int, closed: int) -> None:
    kernel, guard, flags = Kernel.get(device, "close_guard"), word(device, 0), word(device, bad)
    counts = DeviceArray.upload(device, "needed", np.array([needed, 0, 0], np.uint32))
    for step in (5, 6):  # the first one that is bad stays
        given = uniform(device, kernel, "Guarded", step=step, capacity=capacity, rounds=0)
        with Commands(device) as commands:
            commands.dispatch(kernel, 1, guarded=given, needed=counts, bad=flags, guard=guard)
    assert guard.read()[0] == closed
    assert bool(flags.read()[0] >> 31) == (needed > capacity)


@pytest.mark.parametrize("value", [0.0, 1e18, -3.0, np.inf, -np.inf, np.nan, 3e19])
@pytest.mark.parametrize("place", [0, 1500, 2999])
def test_values_that_are_not_finite_are_found(device: Device, value: float, place: int) -> None:
    values = random(3000)
    values[place] = value
    bad = word(device, 2)
    with Commands(device) as commands:
        check_finite(commands, BufferPool(device), on_device(device, values), bad)
    assert bad.read()[0] == (2 if abs(value) < 1e19 else 3)


@pytest.mark.parametrize(("count", "gaussians"), [(1, 1), (7, 100), (100, 100), (33, 70)])
def test_samples_are_different_rows_and_places_near_them(device: Device, count: int, gaussians: int) -> None:
    samples = Samples(count, gaussians, 1234567, 0.25)
    rows = sampled_rows.rows(samples)
    assert len(set(rows.tolist())) == count
    geometry, pool = random(gaussians, 12), BufferPool(device)
    passes, every = SamplePasses(device, pool), on_device(device, geometry)
    with Commands(device) as commands:
        points = passes.places(commands, "near", lambda: samples, every)
        chosen = pool.array("chosen", (count, 12))
        passes.rows(commands, "near", lambda: samples, every, chosen, back=False)
    near = geometry[rows, :3] + sampled_rows.offsets(samples)
    torch.testing.assert_close(read(points), nn.functional.pad(near, (0, 1)), rtol=0, atol=1e-6)
    assert torch.equal(read(chosen), geometry[rows])
    with Commands(device) as commands:
        passes.rows(commands, "near", lambda: samples, every, chosen, back=True)
    twice = geometry.clone()
    twice[rows] *= 2
    assert torch.equal(read(every), twice)


def test_offsets_fill_their_cube() -> None:
    offsets: Tensor = sampled_rows.offsets(Samples(2000, 2000, 42, 1.0))
    assert offsets.abs().max() <= 1
    assert offsets.mean(dim=0).abs().max() < 0.06
    assert (offsets.std(dim=0) - 3**-0.5).abs().max() < 0.03


@pytest.mark.parametrize("guard", [OPEN, CLOSED])
def test_steps_of_corrections(device: Device, guard: int) -> None:
    """Of cameras and of colors, some without a gradient; and the frame that a corrected camera sees."""
    rng, geometry = np.random.default_rng(0), 3 * random(5003, 12)  # of which some lie behind the cameras
    places = rng.uniform([-3, -11, -3], [3, -5, 3], (5, 3))
    cameras = [Camera.looking_at(p, [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=40, height=30) for p in places]
    views = [SimpleNamespace(name=f"train_{number}", camera=camera) for number, camera in enumerate(cameras)]

    points = scene_points(geometry[:, :3], geometry[:, 3].sigmoid())
    config = CamerasConfig("on", Rate(1e-2, 1e-3, 6), 0.3, 1)

    def twin() -> tuple[CameraRefinement, Exposures]:
        return CameraRefinement(cameras, 2.0, config, lambda: points), Exposures(5, Rate(2e-2, 2e-3, 9))

    (exact, exact_colors), (mine, mine_colors) = twin(), twin()
    before = torch.from_numpy(rng.normal(scale=0.02, size=(5, 6)))
    numbers = {view.name: number for number, view in enumerate(views)}
    scene = SimpleNamespace(device=device)
    learners = SimpleNamespace(scene=scene, cameras=mine, exposures=mine_colors, image_numbers=numbers)
    corrections, rasterizer = ResidentCorrections(learners), Rasterizer(device)
    for refinement in (exact, mine):
        refinement.state()["learnt"].copy_(before)
    corrections.push()
    for step, number in enumerate((1, 3, 1, 0, 3, 2), start=1):
        d_camera, d_colors = (torch.from_numpy(rng.normal(size=n) * (step != 4)).float() for n in (6, 12))
        drawing = rasterizer.draw(nothing_but_one(device), cameras[number])
        corrections.begin(views[number], step)
        corrections._d_camera.write(nn.functional.pad(d_camera.reshape(2, 3), (0, 1)).flatten().numpy())
        corrections._d_exposure.write(d_colors.numpy())
        with Commands(device) as commands:
            frame = corrections.move(commands, drawing.arrays["frame"], 0)
            corrections.record_step(commands, word(device, guard), frame, on_device(device, geometry))
        view = frame.read().view(np.float32)[:16].reshape(4, 4).T
        np.testing.assert_allclose(view, exact.refined(cameras[number]).T_cam_world, atol=2e-5)
        if guard == OPEN:
            exact.values.grad, exact_colors.values.grad = torch.zeros(5, 6), torch.zeros(5, 3, 4)
            exact.values.grad[number], exact_colors.values.grad[number] = d_camera, d_colors.reshape(3, 4)
            exact.step(step)
            exact_colors.step(step)
    corrections.pull()
    for found, wanted in ((mine, exact), (mine_colors, exact_colors)):
        for name, value in wanted.state().items():
            assert relative(found.state()[name].detach(), value.detach()) < 3e-5 or not value.any(), name


def nothing_but_one(device: Device) -> Gaussians[DeviceArray]:
    tensors = [torch.zeros(1, 3), torch.ones(1, 4), torch.ones(1, 3), torch.zeros(1), torch.zeros(1, 3)]
    return Gaussians(*(on_device(device, tensor) for tensor in tensors), antialiased=False)
