"""The serial mode: equal seeds give equal bytes, twice in a row and after a stop at any moment."""

from __future__ import annotations

import json
import logging
import signal
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import pytest

from apex_bat.config import Config, ConfigError, load
from apex_bat.launching import local, serial, serial_reports, serial_state
from apex_bat.launching.course import Ended
from apex_bat.launching.standing import Standing
from apex_bat.launching.status import read_status
from apex_bat.launching.supervisor import Watched
from apex_bat.storage import StorageError

TINY = (
    "actors=2", "bats_per_actor=3", "replay.min_size=60", "replay.capacity=300", "replay.samples_per_insert=2.0",
    "learner.batch_size=16", "learner.weights_period=5", "network.channels=[4]", "network.strides=[3]",
    "network.hidden=[16]", "actor.chunk_transitions=10", "actor.weights_period=3", "evaluation.flights=2",
    "evaluation.period_s=1.0", "checkpoint.period_s=0.6", "replay.snapshot_period_s=1.5", "episode.evaluation_steps=12",
    "recording.every_episodes=0", "recording.sampled_flights=0", "recording.curves=false", "rays.num_azimuth=12",
    "rays.num_elevation=2", "sonar.rendering=exact", "train.max_minutes=none", "train.max_env_steps=450",
)  # fmt: skip
"""150 turns of an actor, 3.75 s of simulated time at 40 turns a second."""


class NoView:
    """Shows nothing."""

    def __enter__(self) -> NoView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def show(self, standing: Standing, watched: dict[str, Watched]) -> None:
        assert standing.status(watched)


def config(*changes: str) -> Config:
    return load(None, [*TINY, *changes])


def folder(path: Path) -> Path:
    for name in ("metrics", "checkpoints", "recordings", "logs"):
        (path / name).mkdir(parents=True)
    return path


def test_what_a_serial_run_says_is_in_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "SerialRun", Wordy)
    assert train(tmp_path / "run").outcome == "completed"
    assert "the state was not saved" in (tmp_path / "run" / "logs" / "launcher.log").read_text()


class Wordy:
    """A run that is over at once, and has something to say."""

    def __init__(self, *_: object, is_resumed: bool) -> None:
        del is_resumed

    def follow(self, _view: NoView) -> Ended:
        logging.getLogger(serial.__name__).error("the state was not saved")
        return Ended("completed", "", 0, 0, 0.0)


@pytest.mark.parametrize("is_serial", [True, False])
@pytest.mark.parametrize("is_ignored", [True, False])
def test_a_closed_terminal_ends_a_run_unless_nohup_said_to_ignore_it(is_ignored: bool, is_serial: bool) -> None:
    if not hasattr(signal, "SIGHUP"):
        pytest.skip("this system has no SIGHUP")
    former = signal.signal(signal.SIGHUP, signal.SIG_IGN if is_ignored else signal.SIG_DFL)
    try:
        with serial._stopping(threading.Event()) if is_serial else local.terminable():
            assert (signal.getsignal(signal.SIGHUP) == signal.SIG_IGN) is is_ignored
    finally:
        signal.signal(signal.SIGHUP, former)


def train(run: Path, *changes: str, resume: bool = False) -> Ended:
    return serial.train(config(*changes), run if resume else folder(run), NoView(), is_resumed=resume)


def content(run: Path) -> dict[str, bytes]:
    """What must be equal: every byte of metrics, events and checkpoints."""
    paths = [path for name in ("metrics", "checkpoints") for path in sorted((run / name).rglob("*")) if path.is_file()]
    return {path.relative_to(run).as_posix(): path.read_bytes() for path in paths}


def assert_equal(run: Path, other: Path) -> None:
    one, two = content(run), content(other)
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def fly(run: Path, num_turns: int, num_lost: int, *, ends: bool = False) -> None:
    """Takes turns, saves, takes some that are lost, and breaks off; or ends as by Ctrl-C."""
    with ExitStack() as stack:
        stop = threading.Event()
        made = serial.SerialRun(serial.settings_of(config()), folder(run), stop, stack)
        for _ in range(num_turns):
            made.turn()
        if ends:
            stop.set()
            made.end()
            return
        made.save()
        for _ in range(num_lost):
            made.turn()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was never stopped."""
    run = tmp_path_factory.mktemp("serial") / "whole"
    ended = train(run)
    assert (ended.outcome, ended.env_steps) == ("completed", 450)
    assert ended.learner_steps > 20
    return run


def test_it_is_a_run_with_everything(whole: Path) -> None:
    names = content(whole).keys()
    roles = ("actor-0", "actor-1", "learner", "replay", "evaluator")
    assert {f"metrics/{role}.jsonl" for role in roles} <= names
    assert {"checkpoints/best.npz", "metrics/tensorboard/events.out.tfevents.serial"} <= names
    assert len(serial_state.find(whole)) == 2, "the newest two states are kept"
    assert not list(whole.rglob("*.part"))


def test_equal_seeds_give_equal_bytes_and_other_seeds_others(whole: Path, tmp_path: Path) -> None:
    train(tmp_path / "again")
    assert_equal(whole, tmp_path / "again")
    train(tmp_path / "other", "seed=1", "train.max_env_steps=150")
    one, other = ((run / "metrics" / "learner.jsonl").read_text().splitlines() for run in (whole, tmp_path / "other"))
    assert one[:2] != other[:2]


@pytest.mark.parametrize(
    ("num_turns", "num_lost"),
    [(68, 41), pytest.param(7, 30, marks=pytest.mark.slow), pytest.param(113, 3, marks=pytest.mark.slow)],
)
def test_a_run_that_was_killed_and_resumed_is_the_one_that_never_stopped(
    num_turns: int, num_lost: int, whole: Path, tmp_path: Path
) -> None:
    fly(tmp_path / "run", num_turns, num_lost)
    train(tmp_path / "run", resume=True)
    assert_equal(whole, tmp_path / "run")


@pytest.mark.slow
def test_a_run_that_was_ended_and_resumed_is_the_one_that_never_stopped(whole: Path, tmp_path: Path) -> None:
    fly(tmp_path / "run", 90, 0, ends=True)
    train(tmp_path / "run", resume=True)
    assert_equal(whole, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["train.max_env_steps=300", "train.max_updates=9"])
def test_a_completed_run_goes_on_with_a_higher_limit(limit: str, whole: Path, tmp_path: Path) -> None:
    train(tmp_path / "run", limit)
    train(tmp_path / "run", resume=True)
    assert_equal(whole, tmp_path / "run")


def test_a_run_that_was_stopped_amid_a_turn_ends_that_turn(tmp_path: Path) -> None:
    """Between the evaluator's look and the actor's step: the checkpoint of this turn is for the next turn's look."""
    often = ("checkpoint.period_s=0.001", "evaluation.period_s=0.001", "train.max_env_steps=none")
    train(tmp_path / "whole", *often, "train.max_updates=8")
    train(tmp_path / "run", *often, "train.max_updates=5")
    train(tmp_path / "run", *often, "train.max_updates=8", resume=True)
    assert_equal(tmp_path / "whole", tmp_path / "run")


@pytest.mark.slow
def test_a_torn_state_gives_way_to_the_one_before(
    whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fly(tmp_path / "run", 40, 30)
    first = serial_state.find(tmp_path / "run")[-1]
    first.rename(first.with_name("turn-000000000040"))
    train(tmp_path / "run", "train.max_env_steps=300", resume=True)
    newest = serial_state.find(tmp_path / "run")[-1] / "replay.snapshot"
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(data)
    train(tmp_path / "run", resume=True)
    assert newest.parent.name in caplog.text
    assert_equal(whole, tmp_path / "run")


def test_states_that_are_all_torn_are_never_a_silent_new_start(tmp_path: Path) -> None:
    fly(tmp_path / "run", 20, 0)
    for state in serial_state.find(tmp_path / "run"):
        (state / "state.npz").write_bytes(b"")
    with pytest.raises(StorageError, match="none of the 1 saved states is sound"):
        train(tmp_path / "run", resume=True)
    with pytest.raises(StorageError, match="no saved state"):
        serial.train(config(), folder(tmp_path / "other"), NoView(), is_resumed=True)


def test_metrics_that_were_changed_are_refused(tmp_path: Path) -> None:
    fly(tmp_path / "run", 70, 0)
    (tmp_path / "run" / "metrics" / "actor-0.jsonl").write_bytes(b"")
    with pytest.raises(StorageError, match=r"actor-0\.jsonl: shorter than when the state was saved"):
        train(tmp_path / "run", resume=True)


def test_samples_per_insert_stay_within_the_band_of_the_rate_limiter(tmp_path: Path) -> None:
    with ExitStack() as stack:
        made = serial.SerialRun(serial.settings_of(config()), folder(tmp_path / "run"), threading.Event(), stack)
        for _ in range(140):
            made.turn()
            limiter = made.store.limiter
            if limiter.inserted > limiter.min_size:
                assert abs(limiter.balance) <= limiter.error_buffer
    assert limiter.sampled > 200


def test_cuda_is_refused_because_it_has_no_equal_bits() -> None:
    with pytest.raises(ConfigError, match="device is cuda, and the serial mode promises equal bits"):
        serial.settings_of(config("device=cuda"))
    assert serial.settings_of(config("device=auto")).device == "cpu"


def test_rows_hold_nothing_of_the_machine(whole: Path) -> None:
    for path in sorted((whole / "metrics").glob("*.jsonl")):
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        assert rows, path.name
        for row in rows:
            assert row["pid"] == 0
            assert row["unix_s"] == row["elapsed_s"] <= 3.75
            assert not [name for name in row if name.startswith(("process.", "share."))]


def test_it_ends_at_the_limit_of_wall_clock_time(tmp_path: Path) -> None:
    ended = train(tmp_path / "run", "train.max_minutes=1e-9", "train.max_env_steps=none")
    assert ended.outcome == "completed"
    assert 0 < ended.env_steps < 450


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk_ends_no_run_and_changes_nothing_that_is_learned(
    whole: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = folder(tmp_path / "run")
    (run / "metrics" / "actor-0.jsonl").symlink_to("/dev/full")
    (run / "serial").write_text("a file in the way of all saved states")
    with caplog.at_level(logging.ERROR):
        ended = serial.train(config(), run, NoView())
    assert (ended.outcome, ended.env_steps) == ("completed", 450)
    said = [record.message for record in caplog.records]
    assert sum("actor-0.jsonl: cannot be written: No space left on device; training goes on" in s for s in said) == 1
    assert sum("the state was not saved" in text for text in said) > 1, "it is tried again"
    for name in content(whole):
        if name.startswith("checkpoints/") or name == "metrics/learner.jsonl":
            assert content(run)[name] == content(whole)[name]


def test_the_status_is_kept_up_while_the_evaluator_flies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from apex_bat.evaluation import flights

    monkeypatch.setattr(serial_reports, "STATUS_PERIOD_S", 0.0)
    run, statuses = folder(tmp_path / "run"), []

    def fly(*_: object, is_stopped: Callable[[], bool], **__: object) -> tuple[list[object], list[object]]:
        for _step in range(3):
            (run / "status.json").unlink()
            assert not is_stopped()
            statuses.append(read_status(run)["launcher"])
        stop.set()
        return [], []

    monkeypatch.setattr(flights, "fly", fly)
    with ExitStack() as stack:
        stop = threading.Event()
        serial.SerialRun(serial.settings_of(config()), run, stop, stack).follow(NoView())
    assert statuses == ["runs"] * 3
