"""Presets and overrides: values, round trip, and one clear sentence for each mistake."""

import dataclasses
from pathlib import Path

import pytest

from lapgs_wgpu.cli import keys_help
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.train.config import Rate
from lapgs_wgpu.train.optimizer import rate_at
from lapgs_wgpu.train.presets import (
    ABLATIONS,
    config_keys,
    load_config,
    preset_names,
    write_toml,
)


def write(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


def test_dnerf_is_the_papers_schedule() -> None:
    config = load_config("dnerf")
    assert (config.schedule.steps, config.schedule.warm_up, config.schedule.sh_interval) == (50_000, 3000, 1000)
    assert config.rates.means == Rate(8e-4, 8e-6, 35_000)
    assert config.rates.hash == Rate(8e-3, 8e-5, 45_000)
    assert config.rates.mlp == Rate(8e-4, 1.6e-6, 45_000)
    rates = config.rates
    assert (rates.sh_dc, rates.sh_rest, rates.opacity_logits) == (2.5e-3, 1.25e-4, 0.05)
    assert (rates.log_scales, rates.quats) == (5e-3, 1e-3)
    density = config.density
    assert (density.start, density.stop, density.interval, density.gradient) == (500, 15_000, 100, 2e-4)
    assert (density.min_opacity, density.max_world_size, density.reset_interval) == (0.005, 0.1, 3000)
    assert (config.points.count, config.points.box) == (100_000, 1.3)
    assert (config.data.background, config.seed, config.loss.ssim) == ("black", 0, 0.2)
    assert (config.loss.pyramid, config.loss.ncc) == (0.2, 0.05)
    assert config.field == FieldConfig(negative_scales="mirror")


@pytest.mark.parametrize("name", preset_names())
def test_configuration_survives_toml(name: str, tmp_path: Path) -> None:
    config = load_config(name, {"data.path": 'C:\\a "b" \u00e4', "field.static.base": ["3", "4", "5"]})
    table = dataclasses.asdict(config) | {"record": {"driver": "x", "anything": "\x7f\n"}}
    again = load_config(write(tmp_path / "config.toml", write_toml(table)))
    assert again == config
    assert again.field.static.base == (3, 4, 5)


def test_every_key_can_be_overridden_and_has_a_help_text() -> None:
    help_text = keys_help("dnerf")
    for key in config_keys():
        assert f"--{key} " in help_text, key
    keys = set(config_keys())
    assert {"seed", "data.path", "field.temporal.finest", "rates.means.start", "density.gradient"} <= keys


FULL = load_config("dnerf")


@pytest.mark.parametrize("field", ["static", "mlp", "hexplane", "grid4d"])
def test_a_method_in_short_leaves_out_what_is_the_papers(field: str) -> None:
    config = load_config("dnerf", method=field)
    assert config.field == dataclasses.replace(FULL.field, kind=field)
    assert config.field.dynamics_size == 0
    assert (config.loss.pyramid, config.loss.ncc, config.density.split) == (0, 0, "plain")
    assert config.loss.ssim == FULL.loss.ssim
    assert load_config("dnerf", {"loss.ncc": "0.5"}, method=field).loss.ncc == 0.5  # what is said outright holds
    assert load_config("dnerf", method="laplacian") == FULL


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("laplacian", "field.motion", "mlp"),
        ("dynamics", "field.dynamics", 0),
        ("split", "density.split", "plain"),
        ("lap", "loss.pyramid", 0),
        ("ncc", "loss.ncc", 0),
        ("dy", "loss.dynamics", 0),
        ("hash", "field.temporal_hash", False),
        ("appearance", "field.appearance", "none"),
    ],
)
def test_an_ablation_changes_one_key(part: str, key: str, value: object) -> None:
    """Of the configuration that is whole otherwise."""
    section, name = key.split(".")
    expected = dataclasses.replace(getattr(FULL, section), **{name: value})
    assert expected != getattr(FULL, section)
    assert load_config("dnerf", ablate=[part]) == dataclasses.replace(FULL, **{section: expected})


def test_ablations_add_up_and_must_be_known() -> None:
    config = load_config("dnerf", ablate=["lap", "hash"])
    assert (config.loss.pyramid, config.field.temporal_hash, config.loss.ncc) == (0, False, 0.05)
    assert set(ABLATIONS) == {"laplacian", "dynamics", "split", "lap", "ncc", "dy", "hash", "appearance"}
    with pytest.raises(InputError, match="not 'laplace'; did you mean laplacian"):
        load_config("dnerf", ablate=["laplace"])
    with pytest.raises(InputError, match="did you mean hexplane"):
        load_config("dnerf", method="hexplanes")
    with pytest.raises(InputError, match="must be static or mlp or hexplane or grid4d or laplacian, got 'own'"):
        load_config("dnerf", method="own")
    assert not load_config("dnerf", method="grid4d", ablate=["hash"]).field.temporal_hash
    for method, part in (("grid4d", "ncc"), ("static", "dynamics"), ("hexplane", "hash")):
        with pytest.raises(InputError, match=f"{part}: only the method laplacian has this part, not {method}"):
            load_config("dnerf", method=method, ablate=[part])


def test_overrides() -> None:
    given: dict[str, str | list[str]] = {"schedule.steps": "7", "rates.means.end": "1e-7", "data.background": "white"}
    config = load_config("dnerf", given)
    assert config.schedule.steps == 7
    assert config.rates.means == Rate(8e-4, 1e-7, 35_000)
    assert config.data.background == "white"
    assert config == dataclasses.replace(
        load_config("dnerf"), schedule=config.schedule, rates=config.rates, data=config.data
    )


def test_each_learning_rate_can_be_0_and_goes_from_or_to_0_in_a_line() -> None:
    zero = {key: 0.0 for key in config_keys() if key.startswith("rates.") and not key.endswith(".steps")}
    assert all(
        rate_at(rate, 1) == rate_at(rate, 10**6) == 0 for rate in load_config("dnerf", zero).rates.schedules().values()
    )
    assert rate_at(Rate(0, 1e-3, 10), 5) == rate_at(Rate(1e-3, 0, 10), 5) == 5e-4


def test_base_gives_what_a_file_leaves_out(tmp_path: Path) -> None:
    config = load_config(write(tmp_path / "mine.toml", 'base = "tiny"\n[schedule]\nsteps = 9\n'))
    tiny = load_config("tiny")
    assert config == dataclasses.replace(tiny, schedule=dataclasses.replace(tiny.schedule, steps=9))


@pytest.mark.parametrize("preset", preset_names())
def test_presets_correct_times_after_density_control(preset: str) -> None:
    """Where they are asked to: earlier, an image is not yet drawn as it will be (docs/notes/training.md)."""
    config = load_config(preset, {"timing.refine": True})
    corrections = config.timing.corrections(config.schedule.steps)
    assert len(corrections) >= 3
    assert corrections[0] >= config.density.stop


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps = ", "cannot be read as TOML"),
        ('base = "dnerf"\n[schedule]\nstepz = 5', "no key schedule.stepz; did you mean schedule.steps?"),
        ('base = "dnerf"\n[schedule]\nsteps = "x"', "schedule.steps must be a whole number, got 'x'"),
        ('base = "dnerf"\n[schedule]\nsteps = 0', "at least 1, got 0"),
        ('base = "dnerf"\nschedule = 5', "schedule must be a table, got 5"),
        ('base = "dnerf"\nseed = -1', "seed must lie between 0 and 2147483647, got -1"),
        ('base = "dnerf"\n[loss]\nssim = nan', "loss.ssim must lie between 0 and 2147483647, got nan"),
        ('base = "dnerf"\n[field.static]\nbase = [1, 2]', "field.static.base must be 3 numbers, got [1, 2]"),
        ('base = "dnerf"\n[data]\nbackground = "blak"', "must be black or white, got 'blak'"),
        ("[data]\nsize = 1", 'start the file with base = "dnerf"'),
        ("base = 3", "base must be the name of a preset, got 3"),
        ('base = "nerf"', "there is no preset 'nerf'; did you mean dnerf?"),
    ],
)
def test_mistakes_in_a_file(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        load_config(write(tmp_path / "mine.toml", text))
    assert message in str(caught.value)


def test_keys_that_a_run_of_another_version_has_are_ignored_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'base = "tiny"\nloss.ncc = 0.5\nprecision = "float32"\ndata.split = "test"\nrates.means.half = 3\n'
    with pytest.raises(InputError, match="there is no key precision"):
        load_config(write(tmp_path / "mine.toml", text))
    file = write(tmp_path / "config.toml", f"{text}[record]\ndriver = 'one'\n")
    assert load_config(file) == load_config("tiny", {"loss.ncc": 0.5})
    assert "ignores precision, data.split, rates.means.half, which" in capsys.readouterr().err


def test_a_base_that_leads_back(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    write(path, f'base = "{path}"')
    with pytest.raises(InputError, match="leads back to itself"):
        load_config(str(path))


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("schedule.stepz", "5", "no key 'schedule.stepz'; did you mean schedule.steps?"),
        ("steps", "5", "no key 'steps'; did you mean schedule.steps?"),
        ("schedule.steps", "many", "schedule.steps must be a whole number, got 'many'"),
        ("rates.means.start", "fast", "rates.means.start must be a number, got 'fast'"),
        ("field.kind", "grid5d", "did you mean grid4d?"),
        ("field.static.base", ["1", "2", "x"], "field.static.base must be a whole number, got 'x'"),
        ("field.static.base", ["16", "16"], "field.static.base must be 3 numbers, got ['16', '16']"),
    ],
)
def test_mistakes_in_an_override(key: str, text: str | list[str], message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_config("tiny", {key: text})
    assert message in str(caught.value)
