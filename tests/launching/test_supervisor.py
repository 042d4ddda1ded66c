"""The restart policy, with time and processes driven by hand."""

import errno
from dataclasses import dataclass

import pytest

from apex_bat.config.settings import Launch
from apex_bat.launching.supervisor import Exit, RoleFailedError, Supervisor, describe
from apex_bat.roles.plan import Role

ACTOR = Role("actor", 0)


@dataclass
class Puppet:
    """A role whose end the test decides."""

    pid: int
    ended: Exit | None = None
    waiting: str = ""
    is_asked: bool = False

    def poll(self) -> Exit | None:
        return self.ended

    def stop(self) -> None:
        self.is_asked = True

    def kill(self) -> None:
        self.ended = Exit(-9, "")


class Stage:
    """A supervisor of one actor and the puppets that it started."""

    def __init__(self, launch: Launch | None = None, errors: list[OSError] | None = None) -> None:
        self.errors = errors or []
        self.waiting = ""
        self.puppets: list[Puppet] = []
        self.incarnations: list[int] = []
        self.supervisor = Supervisor([ACTOR], self.start, launch or Launch())
        self.now_s = 0.0
        self.supervisor.start(0.0)

    def start(self, role: Role, incarnation: int) -> Puppet:
        assert role == ACTOR
        if self.errors:
            raise self.errors.pop()
        self.incarnations.append(incarnation)
        self.puppets.append(Puppet(pid=100 + len(self.puppets), waiting=self.waiting))
        return self.puppets[-1]

    def fail(self, now_s: float, code: int = 1) -> None:
        self.look_until(now_s - 1e-3)
        self.puppets[-1].ended = Exit(code, "it broke")
        self.look_until(now_s)

    def look_until(self, now_s: float) -> None:
        """Looks each second, and at the end."""
        while self.now_s < now_s:
            self.now_s = min(self.now_s + 1.0, now_s)
            self.supervisor.watch(self.now_s)


def test_a_failed_role_starts_again_after_the_backoff_and_not_before() -> None:
    stage = Stage(Launch(backoff_s=0.5))
    stage.fail(now_s=10.0)
    stage.look_until(10.4)
    assert len(stage.puppets) == 1
    stage.look_until(10.5)
    assert stage.incarnations == [0, 1]


def test_backoff_doubles_with_quick_failures_and_recovers() -> None:
    stage = Stage(Launch(backoff_s=1.0, max_failures=100))
    now_s, waits = 0.0, []
    for lived_s in (1.0, 1.0, 1.0, 100.0):
        now_s += lived_s
        stage.fail(now_s)
        due_s = stage.supervisor.watched["actor-0"].due_s
        assert due_s is not None
        waits.append(due_s - now_s)
        now_s = due_s
        stage.look_until(now_s)
    assert waits == [1.0, 2.0, 4.0, 1.0]


def test_a_role_that_fails_quickly_too_often_is_given_up_with_the_reason() -> None:
    stage = Stage(Launch(max_failures=2))
    for now_s in (1.0, 5.0):
        stage.fail(now_s)
        stage.look_until(now_s + 2.0)
    with pytest.raises(RoleFailedError, match=r"actor-0: given up after 3 quick failures, the last: .*it broke"):
        stage.fail(9.0)


def test_a_role_that_says_trying_again_is_useless_ends_the_run_at_once() -> None:
    stage = Stage()
    with pytest.raises(RoleFailedError, match=r"^it broke$"):
        stage.fail(1.0, code=2)


def test_a_silent_role_is_killed_and_replaced() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0, backoff_s=1.0))
    stage.supervisor.heard("actor-0", 100, 5.0)
    stage.look_until(14.0)
    assert stage.puppets[0].ended is None
    stage.look_until(15.1)
    assert stage.puppets[0].ended == Exit(-9, "")
    stage.look_until(15.2)
    stage.look_until(16.2)
    assert len(stage.puppets) == 2


def test_a_late_heartbeat_of_a_former_process_does_not_count() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0))
    stage.supervisor.heard("actor-0", 100, 0.0)
    stage.supervisor.heard("actor-0", 99, 9.0)
    stage.look_until(10.5)
    assert stage.puppets[0].ended is not None


def test_a_role_that_ends_by_itself_is_done_and_stays_so() -> None:
    stage = Stage()
    stage.fail(1.0, code=0)
    stage.look_until(100.0)
    assert stage.supervisor.is_done("actor-0")
    assert len(stage.puppets) == 1


def test_a_stopped_role_is_asked_and_not_started_again() -> None:
    stage = Stage()
    assert [w.role for w in stage.supervisor.stop(["actor-0"])] == [ACTOR]
    assert stage.puppets[0].is_asked
    stage.fail(1.0)
    stage.supervisor.stop(["actor-0"])
    stage.look_until(100.0)
    assert len(stage.puppets) == 1


def test_a_role_that_hangs_before_its_first_report_is_replaced_after_the_start_timeout() -> None:
    stage = Stage(Launch(start_timeout_s=40.0, heartbeat_timeout_s=5.0))
    stage.look_until(39.0)
    assert stage.puppets[0].ended is None, "a start may take longer than a heartbeat"
    stage.look_until(40.5)
    stage.look_until(40.6)
    stage.look_until(42.0)
    assert stage.incarnations == [0, 1]
    stage.supervisor.heard("actor-0", 101, 43.0)
    stage.look_until(48.5)
    assert stage.puppets[1].ended == Exit(-9, ""), "once it was heard, the heartbeat counts"


def test_failures_of_a_role_that_worked_for_a_while_are_not_quick() -> None:
    stage = Stage(Launch(quick_failure_s=10.0, max_failures=2))
    now_s = 0.0
    for _ in range(20):
        now_s += 11.0
        stage.fail(now_s)
        now_s += 0.2
        stage.look_until(now_s)
    assert len(stage.puppets) == 21


@pytest.mark.parametrize("when", ["at first", "again"])
def test_a_machine_that_cannot_fork_for_a_while_costs_a_wait_and_not_the_run(when: str) -> None:
    errors = [OSError(errno.EAGAIN, "Resource temporarily unavailable") for _ in range(20)]
    stage = Stage(Launch(max_failures=2), errors if when == "at first" else [])
    if when == "again":
        stage.errors = errors
        stage.fail(1.0)
    watched = stage.supervisor.watched["actor-0"]
    now_s = 0.0
    while errors:
        assert watched.due_s is not None
        now_s = watched.due_s
        stage.look_until(now_s)
    assert watched.reason == "cannot be started: Resource temporarily unavailable"
    assert watched.due_s is not None
    assert watched.due_s - now_s == 30.0, "in the end it is tried every half minute"
    stage.look_until(watched.due_s)
    assert watched.handle is not None
    assert watched.reason == ""


def test_a_program_that_is_missing_ends_the_run_with_the_reason() -> None:
    with pytest.raises(RoleFailedError, match="actor-0: cannot be started: No such file"):
        Stage(errors=[OSError(errno.ENOENT, "No such file or directory")])


def test_a_process_that_cannot_be_killed_is_not_killed_at_each_look() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0))
    stage.supervisor.heard("actor-0", 100, 0.0)
    kills: list[float] = []
    stage.puppets[0].kill = lambda: kills.append(1.0)  # type: ignore[method-assign]
    stage.look_until(19.0)
    assert len(kills) == 1


@pytest.mark.parametrize("code", [130, 143])
def test_a_role_that_somebody_else_ended_starts_again(code: int) -> None:
    stage = Stage()
    stage.fail(1.0, code=code)
    assert not stage.supervisor.is_done("actor-0")
    stage.look_until(2.0)
    assert len(stage.puppets) == 2


@pytest.mark.parametrize("is_heard", [True, False])
def test_a_launcher_that_was_stopped_for_an_hour_kills_nobody_for_its_own_silence(is_heard: bool) -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0, start_timeout_s=10.0))
    stage.look_until(5.0)
    if is_heard:
        stage.supervisor.heard("actor-0", 100, 5.0)
    stage.supervisor.watch(3605.0)
    stage.now_s = 3605.0
    stage.look_until(3608.0 if is_heard else 3607.0)
    assert stage.puppets[0].ended is None
    stage.look_until(3615.0)
    assert stage.puppets[0].ended == Exit(-9, ""), "silence that goes on is noticed all the same"


def test_what_a_launcher_hears_when_it_goes_on_counts_from_then() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0))
    stage.supervisor.heard("actor-0", 100, 3600.0)
    stage.supervisor.watch(3600.0)
    stage.now_s = 3600.0
    stage.look_until(3609.5)
    assert stage.puppets[0].ended is None
    stage.look_until(3610.5)
    assert stage.puppets[0].ended is not None, "no moment of hearing lies in the future"


def test_a_launcher_whose_every_look_is_late_still_notices_silence() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0))
    stage.supervisor.heard("actor-0", 100, 0.0)
    for look in range(1, 7):
        stage.supervisor.watch(5.0 * look)
    assert stage.puppets[0].ended is not None


def test_a_machine_that_cannot_fork_for_a_day_does_not_end_the_run() -> None:
    errors = [OSError(errno.ENOMEM, "Cannot allocate memory") for _ in range(3000)]
    stage = Stage(Launch(max_failures=2), errors)
    watched = stage.supervisor.watched["actor-0"]
    while errors:
        assert watched.due_s is not None
        stage.supervisor.watch(watched.due_s)
    assert watched.due_s is not None
    stage.supervisor.watch(watched.due_s)
    assert watched.handle is not None


def test_starts_that_the_machine_refused_are_no_failures_of_the_role() -> None:
    stage = Stage(Launch(max_failures=2), [OSError(errno.ENOMEM, "Cannot allocate memory") for _ in range(10)])
    watched = stage.supervisor.watched["actor-0"]
    while watched.handle is None:
        assert watched.due_s is not None
        stage.look_until(watched.due_s)
    for _ in range(2):
        stage.fail(stage.now_s + 1.0, code=-9)
        stage.look_until(stage.now_s + 2.0)
    assert watched.handle is not None
    assert watched.due_s is None
    with pytest.raises(RoleFailedError, match="given up after 3 quick failures"):
        stage.fail(stage.now_s + 1.0, code=-9)


def test_a_role_that_is_never_heard_is_given_up() -> None:
    stage = Stage(Launch(start_timeout_s=40.0, quick_failure_s=10.0, max_failures=2))
    with pytest.raises(RoleFailedError, match="given up after 3 quick failures"):
        stage.look_until(200.0)
    assert len(stage.puppets) == 3


def test_a_role_that_waits_for_a_place_is_not_silent_and_not_given_up() -> None:
    stage = Stage(Launch(start_timeout_s=10.0))
    stage.puppets[0].waiting = "waiting for a place"
    stage.look_until(1000.0)
    assert stage.puppets[0].ended is None
    stage.puppets[0].waiting = ""
    stage.look_until(1009.0)
    assert stage.puppets[0].ended is None, "it has as long to begin as any other, from when it had its place"
    stage.look_until(1012.0)
    assert stage.puppets[0].ended is not None


def test_a_role_that_was_lost_with_its_machine_has_not_failed() -> None:
    stage = Stage(Launch(max_failures=0))
    for now_s in range(1, 40):
        stage.puppets[-1].ended = Exit(-9, "host1: it died", is_lost=True)
        stage.look_until(60.0 * now_s)
    assert len(stage.puppets) > 20
    assert stage.supervisor.watched["actor-0"].failures_in_a_row == 0
    assert "lost with its machine: host1: it died" in describe(Exit(-9, "host1: it died", is_lost=True))


def test_the_wait_grows_while_no_place_lets_a_role_begin() -> None:
    stage, waits = Stage(Launch(backoff_s=1.0)), []
    stage.waiting = "waiting for a place"
    for _ in range(4):
        stage.puppets[-1].ended = Exit(None, "no memory there")
        stage.look_until(stage.now_s + 0.5)
        due_s = stage.supervisor.watched["actor-0"].due_s
        assert due_s is not None
        waits.append(due_s - stage.now_s)
        stage.look_until(due_s)
    assert waits == [1.0, 2.0, 4.0, 8.0]
