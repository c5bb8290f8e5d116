"""Training from Python (docs/api.md): the trainer, its parts, and that they are what lapgs-train runs."""

import dataclasses
import json
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.image_losses import BACKGROUND, CAMERA, TRUTH, gaussians, gradients
from helpers.playback import open_playback
from helpers.training import STEPS, configure
from torch import Tensor, nn

import lapgs_wgpu
from lapgs_wgpu import (
    Change,
    Deformation,
    Parts,
    Regularizer,
    Scene4D,
    StepResult,
    TorchLoss,
    Trainer,
    load,
)
from lapgs_wgpu.data import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.checkpoint import read_checkpoint
from lapgs_wgpu.motion.fields.own_field import OwnField
from lapgs_wgpu.motion.timing import Timing
from lapgs_wgpu.splat.rotation import rotate, rotation_matrices
from lapgs_wgpu.train.config import LossWeights, Rate
from lapgs_wgpu.train.exchange_step import ExchangeStep, RenderLoss, render_loss
from lapgs_wgpu.train.ground_truth import upload_rgba
from lapgs_wgpu.train.parts import LossTerm, torch_loss
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.run_folder import load_state, save_state

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")


class Drift(nn.Module):
    """Moves everything alike, and takes whatever else a field is given."""

    def __init__(self, rows: int = 3) -> None:
        super().__init__()
        self.velocity = nn.Parameter(torch.zeros(rows))
        self.seen: set[str] = set()

    def forward(self, means: Tensor, t: float, dynamics: Tensor | None = None) -> Tensor:
        self.seen.add("no codes" if dynamics is None else f"{dynamics.shape[1]} codes")
        return (t * self.velocity).expand(len(means), -1)


def saved(trainer: Trainer, path: Path) -> dict[str, np.ndarray]:
    trainer.save(path)
    return dict(read_checkpoint(path).tensors)


def equal(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


# The trainer


def test_steps_by_hand_are_those_of_a_run(trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path) -> None:
    called: list[int] = []

    def note(trainer: Trainer, result: StepResult) -> None:
        assert trainer.done == result.step
        called.append(result.step)

    with Trainer(configure(), dataset, device, parts=Parts(callbacks=[note])) as trainer:
        first = trainer.step()
        rest = list(trainer)
        found = saved(trainer, tmp_path / "scene.ply")
        metrics = trainer.evaluate()
    assert [first.step, *(result.step for result in rest)] == called == list(range(1, STEPS + 1))
    assert equal(found, dict(read_checkpoint(trained_run / "checkpoint.ply").tensors))
    written, mine = (read_checkpoint(p).metadata for p in (trained_run / "checkpoint.ply", tmp_path / "scene.ply"))
    assert written == mine
    assert metrics["psnr"] == json.loads((trained_run / "metrics.json").read_text())["psnr"]


def test_a_trainer_opens_what_its_configuration_names(data: Path, device: Device) -> None:
    config = load_config("tiny", {"data.path": str(data), "points.count": 50, "schedule.steps": 2})
    with Trainer(config, device=device) as trainer:
        assert trainer.dataset.name == "scene"
        assert len(list(trainer)) == 2
    with pytest.raises(InputError, match="names no data"):
        Trainer(load_config("tiny"), device=device)


def test_values_of_python_are_overrides() -> None:
    given = {"schedule.steps": 7, "rates.sh_dc": 1e-3, "discovery.enabled": False, "field.static.base": [4, 4, 4]}
    config = load_config("tiny", given)
    assert (config.schedule.steps, config.rates.sh_dc, config.discovery.enabled) == (7, 1e-3, False)
    assert config.field.static.base == (4, 4, 4)
    with pytest.raises(InputError, match=r"schedule.steps must be a whole number, got 1\.5"):
        load_config("tiny", {"schedule.steps": 1.5})


def test_terms_add_up_to_the_loss(dataset: Dataset, device: Device) -> None:
    with Trainer(configure(), dataset, device) as trainer:
        results = list(trainer)
    for result in results:
        assert sum(result.terms.values()) == pytest.approx(result.loss, rel=1e-5)
    assert set(results[0].terms) == {"l1", "ssim", "pyramid"}
    assert set(results[-1].terms) == {"l1", "ssim", "pyramid", "ncc", "smoothness", "acceleration", "dynamics"}


def test_an_error_of_a_callback_leaves_the_step_done(
    trained_run: Path, dataset: Dataset, device: Device, tmp_path: Path
) -> None:
    def fail(trainer: Trainer, result: StepResult) -> None:
        if result.step == 3:
            raise RuntimeError("enough")

    with Trainer(configure(), dataset, device, parts=Parts(callbacks=[fail])) as trainer:
        with pytest.raises(RuntimeError, match="enough"):
            list(trainer)
        assert trainer.done == 3
        list(trainer)
        found = saved(trainer, tmp_path / "stopped.ply")
    assert equal(found, dict(read_checkpoint(trained_run / "checkpoint.ply").tensors))


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_step_that_breaks_off_did_not_begin(
    error: type[BaseException], dataset: Dataset, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A notebook's interrupt, too."""

    def fail(*step: object) -> None:
        raise error

    with Trainer(configure(), dataset, device) as trainer:
        trainer.step()
        before = trainer.state()
        monkeypatch.setattr(ExchangeStep, "_descend", fail)
        with pytest.raises(error):
            trainer.step()
        assert trainer.whole
        assert equal(trainer.state(), before)


def test_a_scene_to_start_from_keeps_its_shape_and_its_timing(dataset: Dataset, device: Device) -> None:
    """Though the capture has fewer times than the field has frequencies; and a restored state, too."""
    config = configure()
    scenes = [
        Scene4D.from_points(
            np.zeros((40, 3)),
            np.zeros((40, 3)),
            np.ones(40),
            config.field,
            antialiased=config.antialiased,
            device=device,
        )
        for _ in range(2)
    ]
    assert config.field.components > len(dataset.times)
    scenes[0].timing = Timing(np.array([0.0, 0.5, 1.0]), np.array([0.0, 0.6, 1.0]))
    config = dataclasses.replace(config, timing=dataclasses.replace(config.timing, refine=False))
    with Trainer(config, dataset, device, scene=scenes[0]) as one:
        assert one.config.field == one.scene.field_config == config.field
        one.step()
        state = one.state()
        one.step()
        expected = one.state()
    with Trainer(config, dataset, device, scene=scenes[1]) as two:
        two.restore(state)
        assert two.scene.timing(0.5) == 0.6
        two.step()
        assert equal(two.state(), expected)


# A field of one's own


def test_a_field_of_ones_own_learns_repeats_and_resumes(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    config, states = configure(), []
    for _ in range(2):
        with Trainer(config, dataset, device, parts=Parts(field=Drift())) as trainer:
            assert trainer.config.field.kind == "own"
            for result in trainer:
                if result.step == 20:
                    middle = {name: value.copy() for name, value in trainer.state().items()}
            states.append(saved(trainer, tmp_path / "own.ply"))
    assert equal(*states)
    assert states[0]["field.module.velocity"].any()
    resumed = Drift()
    with Trainer(config, dataset, device, parts=Parts(field=resumed)) as trainer:
        trainer.restore(middle)
        list(trainer)
        assert equal(states[0], saved(trainer, tmp_path / "resumed.ply"))
    assert resumed.seen == {"16 codes"}


def test_a_checkpoint_of_ones_own_field_needs_its_module(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    path, module = tmp_path / "own.ply", Drift()
    with Trainer(configure(field__dynamics="0"), dataset, device, parts=Parts(field=module)) as trainer:
        list(trainer)
        trainer.save(path)
        expected = trainer.scene.at(0.7).means.detach()
    scene = load(path, device, field=Drift())
    assert torch.equal(scene.at(0.7).means, expected)
    assert module.seen == {"no codes"}
    for opened in (lambda: load(path, device), lambda: open_playback(path, device)):
        with pytest.raises(InputError, match=r"own\.ply: the field own needs a module.*load\(path, field=\.\.\.\)"):
            opened()
    for module, named in ((nn.Linear(3, 3), "module.bias"), (Drift(4), "module.velocity")):
        with pytest.raises(InputError, match=rf"own\.ply: is of another field than the module .*{named}"):
            load(path, device, field=module)
    trainer.scene.field_config = dataclasses.replace(trainer.scene.field_config, kind="mlp")
    with Trainer(configure("mlp"), dataset, device) as other:
        other.save(path)
    with pytest.raises(InputError, match="has the field mlp, so no module can be given"):
        load(path, device, field=Drift())


class Rows(nn.Module):
    """Returns what it is told, whatever it is."""

    def __init__(self, value: Any) -> None:
        super().__init__()
        self.value = value
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, means: Tensor, t: float) -> Any:
        return self.value(len(means))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (lambda n: torch.zeros(n, 4), r"Rows must return translation as a Tensor \(300, 3\), got \(300, 4\)"),
        (lambda n: Deformation(orientation=torch.zeros(n, 3)), r"orientation as a Tensor \(300, 4\), got \(300, 3\)"),
        (lambda n: None, "must return a Tensor or Deformation, got NoneType"),
    ],
)
def test_results_of_another_form_are_named(value: Any, message: str, dataset: Dataset, device: Device) -> None:
    config = configure(schedule__warm_up="0")
    with (
        Trainer(config, dataset, device, parts=Parts(field=Rows(value))) as trainer,
        pytest.raises(InputError, match=message),
    ):
        trainer.step()


def test_buffers_of_ones_own_field_are_kept(dataset: Dataset, device: Device, tmp_path: Path) -> None:
    class Masked(Drift):
        def __init__(self, **buffers: Tensor) -> None:
            super().__init__()
            for name, value in buffers.items():
                self.register_buffer(name, value)

    moving = torch.tensor([True, False, True])
    with Trainer(configure(), dataset, device, parts=Parts(field=Masked(moving=moving))) as trainer:
        trainer.step()
        trainer.save(tmp_path / "a.ply")
        state = trainer.state()
    save_state(tmp_path, state)
    assert load_state(tmp_path)["field.module.moving"].tolist() == [True, False, True]
    found = load(tmp_path / "a.ply", device, field=Masked(moving=torch.zeros(3, dtype=torch.bool)))
    assert torch.equal(found.field.module.moving, moving)


def test_all_parts_of_a_deformation_are_optional(dataset: Dataset, device: Device) -> None:
    with Trainer(configure(), dataset, device, parts=Parts(field=Rows(lambda n: Deformation()))) as trainer:
        still, now = trainer.scene.canonical(), trainer.scene.at(0.3)
    assert all(torch.equal(a, b) for a, b in zip(still.arrays().values(), now.arrays().values(), strict=True))


class Pivoted(nn.Module):
    """A quarter turn about the z axis through a pivot."""

    pivot = torch.tensor([[1.0, 2.0, 3.0]])

    def forward(self, means: Tensor, t: float) -> Deformation:
        turn = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]]).expand(len(means), 4)
        return Deformation(rotation=turn, orientation=turn, translation=self.pivot - rotate(turn, self.pivot))


def test_a_field_can_move_the_scene_rigidly(dataset: Dataset, device: Device) -> None:
    with Trainer(configure(), dataset, device, parts=Parts(field=Pivoted())) as trainer, torch.no_grad():
        scene, matrix = trainer.scene, torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        generator = torch.Generator().manual_seed(0)
        for name in ("quats", "log_scales"):  # of no symmetry
            scene.parameters[name] += torch.randn(scene.parameters[name].shape, generator=generator)
        still, now = scene.canonical(), scene.at(0.3)
        before, after = (rotation_matrices(each.quats) * each.scales[:, None] for each in (still, now))
        d_quats = torch.randn(len(scene), 4, generator=generator)
        module = Rows(lambda n: Deformation(orientation=torch.tensor([[0.0, 0.0, 0.0, 1.0]] * n), d_quats=d_quats))
        both = Scene4D(scene.parameters, trainer.config.field, device, own_field=module).at(0.3)
    torch.testing.assert_close(now.means, Pivoted.pivot + (still.means - Pivoted.pivot) @ matrix.T)
    torch.testing.assert_close(after @ after.mT, matrix @ (before @ before.mT) @ matrix.T)
    w, x, y, z = still.quats.unbind(1)
    half_turn = torch.stack([-z, -y, x, w], dim=1)  # k (w + x i + y j + z k)
    torch.testing.assert_close(both.quats, nn.functional.normalize(half_turn + d_quats, dim=1))


def test_a_class_in_place_of_a_module_is_refused() -> None:
    with pytest.raises(InputError, match=r"must be an nn.Module, such as field=Drift\(\) .* got <class .*Drift"):
        OwnField(Drift)  # type: ignore[arg-type]


def test_groups_of_ones_own_field_have_rates_of_their_own(dataset: Dataset, device: Device) -> None:
    class Grouped(Drift):
        def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
            return {"drift": [self.velocity]}

    with pytest.raises(InputError, match=r"group drift has no learning rate; give Parts\(rates=\{'drift': "):
        Trainer(configure(), dataset, device, parts=Parts(field=Grouped()))
    with pytest.raises(InputError, match="names drft, which is no group of parameters; there are means"):
        Trainer(configure(), dataset, device, parts=Parts(field=Grouped(), rates={"drift": 1.0, "drft": 1.0}))
    module = Grouped()
    parts = Parts(field=module, rates={"drift": Rate(1e-3, 1e-3, 1), "means": 1e-9})
    with Trainer(configure(schedule__warm_up="0"), dataset, device, parts=parts) as trainer:
        before = trainer.scene.parameters["means"].detach().clone()
        trainer.step()
        assert module.velocity.abs().max().item() == pytest.approx(1e-3, rel=1e-3)  # Adam's first step
        assert (trainer.scene.parameters["means"] - before).abs().max() < 2e-7

    impossible = (
        {"means": [module.velocity]},  # a group of the training's own
        {},  # lacks velocity
        {"mlp": [module.velocity], "hash": [module.velocity]},
    )
    for groups in impossible:
        module.parameter_groups = lambda groups=groups: groups  # type: ignore[method-assign]
        with pytest.raises(InputError, match="group"):
            Trainer(configure(), dataset, device, parts=Parts(field=module))


def test_a_scene_to_start_from_keeps_its_field(dataset: Dataset, device: Device) -> None:
    with Trainer(configure(), dataset, device, parts=Parts(field=Drift())) as trainer:
        scene = trainer.scene
    with pytest.raises(InputError, match=r"keeps its own field; leave out Parts\(field=\.\.\.\)"):
        Trainer(configure(), dataset, device, scene=scene, parts=Parts(field=Drift()))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"losses": [len]}, "losses=...) must list Regularizer and TorchLoss, got a builtin"),
        ({"rates": {"mlp": (1e-2, 1e-3)}}, "gives mlp (0.01, 0.001); give 0 or more, or Rate("),
    ],
)
def test_parts_of_another_kind_are_refused(parts: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        Parts(**parts)
    assert message in str(caught.value)


def test_arguments_of_another_kind_are_refused(dataset: Dataset, device: Device) -> None:
    with pytest.raises(InputError, match="takes as config what load_config gives, got a dict"):
        Trainer({}, dataset, device)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="takes as dataset what load_dataset gives, got a str"):
        Trainer(configure(), "runs/synthetic", device)  # type: ignore[arg-type]
    with Trainer(configure(), dataset, device) as trainer:
        view = dataset.test[0]
        listed, tensor = ([0.25, 0.5, 1], torch.tensor([0.25, 0.5, 1]))
        images = [trainer.scene.render(view.camera, 0.5, background=each).image for each in (listed, tensor)]
        assert torch.equal(*images)
        with pytest.raises(InputError, match=r"not written \(No such file or directory\)"):
            trainer.save("nowhere/scene.ply")


# Losses of one's own


def lossy(device: Device, *own: tuple[LossTerm, float], weights: LossWeights) -> tuple[RenderLoss, dict[str, Tensor]]:
    scene = gaussians()
    truth = upload_rgba(device, TRUTH)
    done = render_loss(scene, CAMERA, truth, BACKGROUND, weights, device, None, own)  # type: ignore[arg-type]
    done.loss.backward()
    return done, gradients(scene, done)


def test_a_term_in_torch_has_the_gradient_of_the_fused_one(device: Device) -> None:
    own = TorchLoss("mine", lambda image, truth: (image - truth).abs().mean())
    fused, expected = lossy(device, weights=LossWeights(0.9, 0.1))
    mixed, found = lossy(device, (own, 0.5), weights=LossWeights(0.4, 0.1))
    assert mixed.terms["mine"] == pytest.approx(fused.terms["l1"], rel=1e-5)
    assert mixed.loss.item() == pytest.approx(fused.loss.item(), rel=1e-5)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-6)


def charbonnier(image: Tensor, truth: Tensor) -> Tensor:
    return ((image - truth).square() + 1e-4).sqrt().sum(dim=2).mean()


@pytest.mark.kernels
def test_terms_of_ones_own_leave_out_what_the_losses_do(device: Device) -> None:
    rng, (height, width) = np.random.default_rng(0), (13, 21)
    planes = rng.random((4, height, width)).astype(np.float32)
    rgba = rng.integers(1, 256, (height, width, 4), np.uint8)
    rgba[3:7, 5:, 3] = 0
    left_out = rgba[..., 3] == 0
    shown, truth = DeviceArray.upload(device, "image", planes), upload_rgba(device, rgba)
    image = torch.from_numpy(planes[:3]).permute(1, 2, 0).double()
    target = torch.from_numpy(rgba[..., :3]).double() / 255
    target[left_out] = image[left_out]
    expected = charbonnier(image, target).item()
    in_torch, gradient = torch_loss(TorchLoss("mine", charbonnier), shown, truth, 0.3)
    assert in_torch == pytest.approx(expected, rel=1e-5)
    assert (gradient[:, left_out] == 0).all()
    assert (gradient[:3, ~left_out] != 0).all()


def test_terms_of_the_gaussians_and_weights_by_step(dataset: Dataset, device: Device) -> None:
    times: list[float] = []

    def spread(scene: Scene4D, now: lapgs_wgpu.Gaussians, t: float) -> Tensor:
        times.append(t)
        return now.means.square().mean()

    losses = [Regularizer("spread", spread, weight=lambda step: 1e3 if step > 2 else 0.0)]
    with Trainer(configure(), dataset, device, parts=Parts(losses=losses)) as trainer:
        results = [trainer.step() for _ in range(4)]
    assert ["spread" in result.terms for result in results] == [False, False, True, True]
    assert len(times) == 2
    assert results[3].terms["spread"] < results[2].terms["spread"]
    assert sum(results[2].terms.values()) == pytest.approx(results[2].loss, rel=1e-5)


def test_a_term_that_is_not_finite_is_named(dataset: Dataset, device: Device) -> None:
    own = TorchLoss("mine", lambda image, truth: (image * float("nan")).mean())
    with Trainer(configure(), dataset, device, parts=Parts(losses=[own])) as trainer:
        result = trainer.step()
    assert result.skipped is not None
    assert "the loss term mine is nan" in str(result.skipped)


def test_losses_that_cannot_be_are_refused(dataset: Dataset, device: Device) -> None:
    twice = [TorchLoss("mine", charbonnier), TorchLoss("mine", charbonnier)]
    taken = [([TorchLoss(name, charbonnier)], name) for name in ("l1", "loss", "psnr")]
    for losses, name in ((twice, "mine"), *taken):
        with pytest.raises(InputError, match=f"two loss terms named '{name}'"):
            Parts(losses=losses)
    rows = TorchLoss("mine", lambda image, truth: image.mean(dim=0))
    with (
        Trainer(configure(), dataset, device, parts=Parts(losses=[rows])) as trainer,
        pytest.raises(InputError, match=r"the loss 'mine' must return a scalar, got torch.Size\(\[32, 3\]\)"),
    ):
        trainer.step()


# A density rule of one's own


def test_a_rule_may_do_anything_with_the_gaussians(dataset: Dataset, device: Device) -> None:
    steps: list[int] = []

    def halve(state: lapgs_wgpu.DensityState) -> Change:
        steps.append(state.step)
        assert state.statistics.views.max() > 0
        assert not any(row.requires_grad for row in state.rows.values())
        keep = torch.arange(len(state.rows["means"])) % 2 == 0
        return Change(keep, {name: row[:1] for name, row in state.rows.items()})

    config = configure(density__min_contribution="0")
    with Trainer(config, dataset, device, parts=Parts(density=halve)) as trainer:
        list(trainer)
        assert steps == [10, 20, 30]
        assert len(trainer.scene) == 40  # 300, 151, 77, 40: half of each and one more
    assert trainer.scene.parameters["means"].isfinite().all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda rows: Change(torch.ones(3), dict(rows)), r"keep must be bool of shape \(300,\)"),
        (lambda rows: Change(torch.ones(300, dtype=torch.bool), {}), "added must have the rows means, "),
        (
            lambda rows: Change(torch.ones(300, dtype=torch.bool), {**rows, "quats": rows["means"]}),
            r"added\['quats'\] must be float32 \(300, 4\)",
        ),
    ],
)
def test_changes_that_cannot_be_are_named(change: Any, message: str, dataset: Dataset, device: Device) -> None:
    parts = Parts(density=lambda state: change(state.rows))
    with (
        Trainer(configure(), dataset, device, parts=parts) as trainer,
        pytest.raises(InputError, match=message),
    ):
        list(trainer)


# The page, and the measures of a run


BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.S)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_code_of_the_page_runs(
    number: int, data: Path, dataset: Dataset, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code = BLOCKS[number]
    code = code.replace('"synthetic", "schedule.steps": 300', f'"{data}", "schedule.steps": 60')
    code = code.replace('{"data.path": "DIR"}', f'{{"data.path": "{data}", "schedule.steps": 5}}')
    names: dict[str, Any] = {}
    exec(code.replace('"DIR"', f'"{data}"'), names)
    if "parts" in names:
        with closing(Trainer(configure(), dataset, device, parts=names["parts"])) as trainer:
            assert len(list(trainer)) == STEPS


def test_the_page_names_all_that_is_public() -> None:
    training = set(lapgs_wgpu.__all__) - {"Camera", "Gaussians", "Rendering", "rasterize"}
    assert all(f"`{name}" in PAGE for name in training), training
