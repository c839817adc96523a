"""Presets and their checks."""

import pytest
import yaml

from kronc_ns.commands.options import SolverOptions
from kronc_ns.errors import KroncError
from kronc_ns.files.presets import load_config, preset_folder, preset_names
from kronc_ns.fit.options import KroncConfig

PRESETS = sorted(path.stem for path in preset_folder().glob("*.yaml"))


@pytest.fixture
def written(tmp_path):
    def write(text: str) -> str:
        (tmp_path / "mine.yaml").write_text(text)
        return str(tmp_path / "mine.yaml")

    return write


def test_the_presets_that_the_help_names_exist():
    assert {"paper_synthetic", "paper_real", "phone_walk", "turntable"} <= set(PRESETS)
    assert preset_names() == PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_says_what_it_sets(name):
    config = load_config(name)
    content = yaml.safe_load((preset_folder() / f"{name}.yaml").read_text())
    for key, value in content.items():
        if key != "adam":
            assert getattr(config, key) == value
    for key, value in content["adam"].items():
        assert getattr(config.adam, key) == value


def test_no_preset_and_an_empty_one_are_the_defaults(written):
    assert load_config() == load_config(written("# nothing\n")) == KroncConfig()


def test_unset_values_keep_their_defaults_and_integers_pass_for_numbers(written):
    config = load_config(written("radius_m: 6\nadam:\n  steps: 7\n"))
    assert (config.radius_m, config.adam.steps) == (6.0, 7)
    assert isinstance(config.radius_m, float)
    assert config.adam.learning_rate == KroncConfig().adam.learning_rate
    assert config.laps == KroncConfig().laps


def test_numbers_in_scientific_notation_are_numbers(written):
    assert load_config(written("adam:\n  learning_rate: 1e-3\n")).adam.learning_rate == 0.001


def test_overrides_win_over_the_preset_and_none_leaves_it(written):
    path = written("direction: cw\nlaps: 0.5\nseed: 4\n")
    config = load_config(path, direction="ccw", seed=0, laps=None)
    assert (config.direction, config.seed, config.laps) == ("ccw", 0, 0.5)
    assert SolverOptions(config=path, seed=0).solver_config() == load_config(path, seed=0)


def test_impossible_overrides_are_refused():
    with pytest.raises(KroncError, match="laps"):
        load_config(None, laps=0.0)


def test_any_option_counts_even_one_that_is_zero():
    assert not SolverOptions().any_solver_option()
    assert SolverOptions(seed=0).any_solver_option()
    assert SolverOptions(config="turntable").any_solver_option()


def test_an_unknown_preset_names_the_known_ones():
    with pytest.raises(KroncError) as caught:
        load_config("phone_wlak")
    assert "phone_wlak" in str(caught.value)
    assert all(name in str(caught.value) for name in PRESETS)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("radius: 4.0\n", ["'radius'", "radius_m"]),
        ("adam:\n  stps: 10\n", ["adam", "'stps'", "steps"]),
        ("1: 2\n", ["1", "radius_m"]),
        ("radius_m: four\n", ["radius_m", "'four'", "float"]),
        ("radius_m: null\n", ["radius_m", "None"]),
        ("seed: 1.5\n", ["seed", "1.5", "int"]),
        ("seed: true\n", ["seed", "True", "int"]),
        ("laps: true\n", ["laps", "True", "float"]),
        ("direction: left\n", ["direction", "'left'", "ccw", "cw"]),
        ("direction: [ccw]\n", ["direction", "ccw"]),
        ("adam: 3\n", ["adam", "mapping", "int"]),
        ("adam:\n  optimise_depths: 1\n", ["optimise_depths", "1", "bool"]),
        ("adam:\n  steps: 1e3\n", ["steps", "1e3", "int"]),
        ("- radius_m\n", ["mapping", "list"]),
        ("radius_m: [4.0\n", ["not valid YAML"]),
        ("radius_m: 4.0\n  laps: 1\n", ["not valid YAML"]),
        ("\x07", ["not valid YAML"]),
    ],
)
def test_errors_name_the_file_the_key_and_what_was_expected(written, text, parts):
    path = written(text)
    with pytest.raises(KroncError) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)
    for part in [path, *parts]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("text", "name"), [("radius_m: -1\n", "radius_m"), ("laps: .inf\n", "laps"), ("adam:\n  steps: 0\n", "adam.steps")]
)
def test_impossible_values_name_the_file_too(written, text, name):
    path = written(text)
    with pytest.raises(KroncError, match=name) as caught:
        load_config(path)
    assert path in str(caught.value)


def test_bytes_that_are_no_text_are_no_yaml(tmp_path):
    (tmp_path / "mine.yaml").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(KroncError, match="not valid YAML"):
        load_config(str(tmp_path / "mine.yaml"))
