"""The restart policy, with time and processes driven by hand."""

from dataclasses import dataclass

import pytest

from apex_bat.config.settings import Launch
from apex_bat.launching.supervisor import Exit, RoleFailedError, Supervisor
from apex_bat.roles.plan import Role

ACTOR = Role("actor", 0)


@dataclass
class Puppet:
    """A role whose end the test decides."""

    pid: int
    ended: Exit | None = None
    is_asked: bool = False

    def poll(self) -> Exit | None:
        return self.ended

    def stop(self) -> None:
        self.is_asked = True

    def kill(self) -> None:
        self.ended = Exit(-9, "")


class Stage:
    """A supervisor of one actor and the puppets that it started."""

    def __init__(self, launch: Launch | None = None) -> None:
        self.puppets: list[Puppet] = []
        self.incarnations: list[int] = []
        self.supervisor = Supervisor([ACTOR], self.start, launch or Launch())
        self.supervisor.start(0.0)

    def start(self, role: Role, incarnation: int) -> Puppet:
        assert role == ACTOR
        self.incarnations.append(incarnation)
        self.puppets.append(Puppet(pid=100 + len(self.puppets)))
        return self.puppets[-1]

    def fail(self, now_s: float, code: int = 1) -> None:
        self.puppets[-1].ended = Exit(code, "it broke")
        self.supervisor.watch(now_s)


def test_a_failed_role_starts_again_after_the_backoff_and_not_before() -> None:
    stage = Stage(Launch(backoff_s=0.5))
    stage.fail(now_s=10.0)
    stage.supervisor.watch(10.4)
    assert len(stage.puppets) == 1
    stage.supervisor.watch(10.5)
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
        stage.supervisor.watch(now_s)
    assert waits == [1.0, 2.0, 4.0, 1.0]


def test_a_role_that_fails_quickly_too_often_is_given_up_with_the_reason() -> None:
    stage = Stage(Launch(max_failures=2))
    for now_s in (1.0, 5.0):
        stage.fail(now_s)
        stage.supervisor.watch(now_s + 2.0)
    with pytest.raises(RoleFailedError, match=r"actor-0: given up after 3 quick failures, the last: .*it broke"):
        stage.fail(9.0)


def test_a_role_that_says_trying_again_is_useless_ends_the_run_at_once() -> None:
    stage = Stage()
    with pytest.raises(RoleFailedError, match=r"^it broke$"):
        stage.fail(1.0, code=2)


def test_a_silent_role_is_killed_and_replaced() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0, backoff_s=1.0))
    stage.supervisor.heard("actor-0", 100, 5.0)
    stage.supervisor.watch(14.0)
    assert stage.puppets[0].ended is None
    stage.supervisor.watch(15.1)
    assert stage.puppets[0].ended == Exit(-9, "")
    stage.supervisor.watch(15.2)
    stage.supervisor.watch(16.2)
    assert len(stage.puppets) == 2


def test_a_late_heartbeat_of_a_former_process_does_not_count() -> None:
    stage = Stage(Launch(heartbeat_timeout_s=10.0))
    stage.supervisor.heard("actor-0", 99, 9.0)
    stage.supervisor.watch(10.5)
    assert stage.puppets[0].ended is not None


def test_a_role_that_ends_by_itself_is_done_and_stays_so() -> None:
    stage = Stage()
    stage.fail(1.0, code=0)
    stage.supervisor.watch(100.0)
    assert stage.supervisor.is_done("actor-0")
    assert len(stage.puppets) == 1


def test_a_stopped_role_is_asked_and_not_started_again() -> None:
    stage = Stage()
    assert [w.role for w in stage.supervisor.stop(["actor-0"])] == [ACTOR]
    assert stage.puppets[0].is_asked
    stage.fail(1.0)
    stage.supervisor.stop(["actor-0"])
    stage.supervisor.watch(100.0)
    assert len(stage.puppets) == 1
