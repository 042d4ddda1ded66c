"""A run that stands still says so, once a period, and who says what."""

import logging

import pytest

from apex_bat.launching.progress import Progress

ROLES = [
    {"role": "replay", "state": "waiting for actors: 5 transitions are missing"},
    {"role": "actor-0", "state": "waiting to be restarted: cannot be started"},
]


def test_a_run_that_moves_does_not_stand_still() -> None:
    progress = Progress(10.0, 0.0)
    for second in range(100):
        progress.take(float(second // 9), 0.0, float(second))
        assert progress.stall(ROLES, float(second)) == ""


@pytest.mark.parametrize("moving", [(1.0, 0.0), (0.0, 1.0)], ids=["steps", "updates"])
def test_steps_alone_or_updates_alone_are_progress(moving: tuple[float, float]) -> None:
    progress = Progress(10.0, 0.0)
    for second in range(30):
        progress.take(moving[0] * second, moving[1] * second, float(second))
    assert progress.stall(ROLES, 30.0) == ""


def test_a_standstill_names_what_each_role_waits_for_and_is_logged_once_a_period(
    caplog: pytest.LogCaptureFixture,
) -> None:
    progress = Progress(10.0, 0.0)
    progress.take(7.0, 3.0, 1.0)
    with caplog.at_level(logging.WARNING):
        texts = []
        for second in range(1, 35):
            progress.take(7.0, 3.0, float(second))
            texts.append(progress.stall(ROLES, float(second)))
    assert texts[8] == ""
    assert texts[-1] == (
        "no environment step and no update for 33 s (replay: waiting for actors: 5 transitions are missing; "
        "actor-0: waiting to be restarted: cannot be started)"
    )
    assert len(caplog.records) == 3, "at 10, 20 and 30 s"


def test_going_back_to_a_checkpoint_is_not_a_standstill() -> None:
    progress = Progress(10.0, 0.0)
    progress.take(7.0, 300.0, 1.0)
    progress.take(7.0, 200.0, 9.0)
    assert progress.stall(ROLES, 15.0) == ""
