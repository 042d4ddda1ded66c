"""Settings from files and the command line: what is refused, and in which words."""

import os
from pathlib import Path

import msgspec
import pytest

from apex_bat.config import Config, ConfigError, load, save
from apex_bat.config.loading import differences, places_anywhere

FOLDER = Path(__file__).parents[2] / "configs"
CONFIGS = sorted(FOLDER.glob("*.toml"))


def test_defaults_load_without_a_file() -> None:
    assert load() == Config()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_shipped_configuration_loads_and_survives_saving(path: Path, tmp_path: Path) -> None:
    config = load(path)
    save(config, tmp_path / "config.toml")
    assert load(tmp_path / "config.toml") == config


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_shipped_configuration_says_its_question_first(path: Path) -> None:
    assert path.read_text().startswith("# ")


@pytest.mark.parametrize(
    ("override", "value"),
    [("replay.capacity=5_000", 5000), ("arena=narrow", "narrow"), ("network.channels=[4]", None), ("seed=7", 7)],
)
def test_overrides_are_toml_values_or_bare_words(override: str, value: object) -> None:
    extra = ["network.strides=[1]"] if "channels" in override else []
    flat = msgspec.to_builtins(load(None, [override, *extra]))
    for part in override.partition("=")[0].split("."):
        flat = flat[part]
    assert flat == (value if value is not None else (4,))


def test_none_takes_a_limit_away_and_survives_saving(tmp_path: Path) -> None:
    config = load(None, ["train.max_minutes=none", "train.max_updates=10"])
    assert config.train.max_minutes is None
    save(config, tmp_path / "config.toml")
    assert load(tmp_path / "config.toml") == config


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("replay.capcity=5", "replay.capcity: no such setting; did you mean replay.capacity?"),
        ("sonr.rendering=exact", "sonr: no such setting; did you mean sonar?"),
        ("capacity=5", "did you mean replay.capacity?"),
        ("replay.capacity=many", "replay.capacity: expected `int`, got `str`"),
        ("replay.capacity=4", "replay.capacity: expected `int` >= 16"),
        ("condition=deaf", "condition: invalid enum value 'deaf'"),
        ("replay.min_size=900_000", "min_size 900000 exceeds capacity 200000"),
        ("train.max_minutes=none", "training never ends"),
        ("network.channels=[4]", "give one each"),
        ("sonar.temperature_c=20.0", "do nothing unless absorption_db_m is None"),
        ("recording.actors=[0,2]", "recording.actors names actor 2, and the 2 actors have the numbers 0 to 1"),
        ("seed", "expected section.key=value"),
        ("seed.x.y=3", "seed"),
        ("", "expected section.key=value"),
    ],
)
def test_wrong_settings_are_refused_by_name(override: str, says: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(None, [override])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [(b"seed = ", "not valid TOML"), (b"\xff\xfe", "cannot be read"), (b"seed = 'x'", "seed: expected `int`")],
)
def test_files_that_cannot_be_used_are_named(text: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=says) as caught:
        load(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "begins"),
    [
        (["replay.capacity=few"], "--set replay.capacity=few: replay.capacity: "),
        (["actors=1", "actors=-1", "bats_per_actor=4"], "--set actors=-1: actors: "),
        (["reply.capacity=5"], "--set reply.capacity=5: reply: no such setting"),
        (["network.channels=[4,'x']"], "--set network.channels=[4,'x']: network.channels["),
        (["actors=2"], "{path}: seed: "),
    ],
)
def test_a_wrong_value_is_told_with_where_it_came_from(overrides: list[str], begins: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text("seed = 'x'" if "{path}" in begins else "seed = 1")
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    assert str(caught.value).startswith(begins.format(path=path))


@pytest.mark.parametrize(("cores", "actors"), [(1, 1), (2, 1), (4, 2), (64, 62)])
def test_the_bats_configurations_use_the_cores_that_there_are(
    cores: int, actors: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(cores), raising=False)
    for name in ("memory", "no_memory", "onset"):
        config = load(FOLDER / f"{name}.toml")
        assert (config.actors, config.cluster.grow) == (actors, False)
        assert load(FOLDER / f"{name}.toml", (), places_anywhere).actors == 2
        assert load(FOLDER / f"{name}.toml", ["actors=3"]).actors == 3


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: no such file"):
        load(Path("nowhere.toml"))


def test_differences_name_the_settings() -> None:
    assert differences(load(), load(None, ["replay.capacity=7777"])) == ["replay.capacity: 200000 | 7777"]
