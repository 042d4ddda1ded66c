"""How a run stands: what the roles' reports add up to. The views, status.json and the limits read it."""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from apex_bat.config import Config
from apex_bat.launching.progress import Progress
from apex_bat.launching.supervisor import Watched
from apex_bat.roles.plan import Role, roles_of
from apex_bat.transport.messages import Report

_RECENT_REPORTS = 30
_A_WHILE_S = 5.0


class RoleStanding:
    """What is known of one role."""

    def __init__(self) -> None:
        self.newest: Report | None = None
        self.heard_s: float | None = None
        self._before: dict[str, float] = {}

    def take(self, report: Report, now_s: float) -> None:
        """Takes a report; the counters of a former process are added to those of the new one."""
        former = self.newest
        if former is not None and (former.pid, former.host) != (report.pid, report.host):
            for name, value in former.metrics.items():
                self._before[name] = self._before.get(name, 0.0) + value
        self.newest, self.heard_s = report, now_s

    def total(self, name: str) -> float:
        """Returns a counter over all processes that the role has had."""
        return self._before.get(name, 0.0) + self.gauge(name, 0.0)

    def gauge(self, name: str, default: float = float("nan")) -> float:
        """Returns a figure of the newest report."""
        return default if self.newest is None else self.newest.metrics.get(name, default)


class Origin(NamedTuple):
    """What the earlier parts of a resumed run have done and used up."""

    env_steps: float = 0.0
    episodes: float = 0.0
    updates: float = 0.0
    elapsed_s: float = 0.0
    """Time in which it flew."""


NEW_RUN = Origin()
"""That of a run which was not resumed."""


class Standing:
    """How the run stands at a moment."""

    def __init__(self, config: Config, now_s: float, origin: Origin = NEW_RUN) -> None:
        self.config = config
        self._origin = origin
        self.roles = {role.name: RoleStanding() for role in roles_of(config)}
        self.began_s = now_s
        self.now_s = now_s
        self.flying_since_s: float | None = None
        self.stall = ""
        """Since when nothing moves and what the roles say of it; empty while the run goes on."""
        self._progress = Progress(config.launch.stall_s, now_s)
        self._recent: dict[str, deque[tuple[float, float]]] = {
            name: deque(maxlen=_RECENT_REPORTS * config.actors) for name in ("return", "return_greedy")
        }

    def add(self, role: Role) -> None:
        """Counts a role more."""
        self.roles[role.name] = RoleStanding()
        if role.kind == "actor":
            self._recent = {
                name: deque(recent, maxlen=(recent.maxlen or 0) + _RECENT_REPORTS)
                for name, recent in self._recent.items()
            }

    def take(self, report: Report, now_s: float) -> None:
        """Takes the report of a role; one of a role that the run does not have is ignored."""
        if report.role not in self.roles:
            return
        self.roles[report.role].take(report, now_s)
        for name, recent in self._recent.items():
            if name in report.metrics and report.role.startswith("actor"):  # not the evaluator's much longer flights
                recent.append((report.metrics[name], report.metrics.get(f"{name}_count", 1.0)))
        if self.flying_since_s is None and self.env_steps > self._origin.env_steps:
            self.flying_since_s = now_s

    @property
    def env_steps(self) -> float:
        """Environment steps of all bats."""
        return self._origin.env_steps + self._sum("env_steps")

    @property
    def env_steps_per_s(self) -> float:
        """Their present rate."""
        return sum(role.gauge("env_steps_per_s", 0.0) for role in self.roles.values())

    @property
    def episodes(self) -> float:
        """Episodes ended."""
        return self._origin.episodes + self._sum("episodes")

    @property
    def elapsed_s(self) -> float:
        """Time since the first environment step; pauses before the run was resumed do not count."""
        return self._origin.elapsed_s + (0.0 if self.flying_since_s is None else self.now_s - self.flying_since_s)

    @property
    def learner_step(self) -> float:
        """Updates of the network."""
        return self.roles["learner"].gauge("learner_step", self._origin.updates)

    @property
    def is_under_way(self) -> bool:
        """Whether this part of the run has learnt something, or flown for a while: its start is over."""
        if self.flying_since_s is None:
            return False
        return self.learner_step > self._origin.updates or self.now_s - self.flying_since_s > _A_WHILE_S

    def recent(self, name: str) -> float | None:
        """Returns the mean of `return` or `return_greedy` over the newest reports; None before the first."""
        values = self._recent[name]
        number = sum(count for _, count in values)
        return sum(mean * count for mean, count in values) / number if number else None

    @property
    def limits(self) -> list[tuple[str, float, float]]:
        """For each limit of the run: its name, how far it is used, and how far it goes."""
        train = self.config.train
        return [
            (name, used, float(limit))
            for name, used, limit in (
                ("minutes", self.elapsed_s / 60.0, train.max_minutes),
                ("env steps", self.env_steps, train.max_env_steps),
                ("updates", self.learner_step, train.max_updates),
            )
            if limit is not None
        ]

    @property
    def time_left_s(self) -> float | None:
        """Estimate of the time until the first limit is reached; None before the first step."""
        shares = [used / limit for _, used, limit in self.limits]
        share = max(shares)
        return None if share <= 0.0 else self.elapsed_s * (1.0 - share) / share

    @property
    def is_over(self) -> bool:
        """Whether a limit is reached."""
        return any(used >= limit for _, used, limit in self.limits)

    def look(self, watched: dict[str, Watched]) -> None:
        """Looks whether the run moves on; if not, `stall` says so."""
        self._progress.take(self.env_steps, self.learner_step, self.now_s)
        self.stall = self._progress.stall(self.status(watched), self.now_s)

    def progress(self) -> dict[str, float]:
        """Returns what a run that is resumed goes on from, the fields of `Origin`."""
        return Origin(self.env_steps, self.episodes, self.learner_step, self.elapsed_s)._asdict()

    def status(self, watched: dict[str, Watched]) -> list[dict[str, Any]]:
        """Returns each role's standing as `status --json` prints it."""
        return [self._status(name, watched[name]) for name in self.roles]

    def _status(self, name: str, watched: Watched) -> dict[str, Any]:
        known = self.roles[name]
        report = known.newest
        if watched.is_done:
            state = "ended"
        elif watched.handle is not None:
            state = watched.handle.waiting or "starting"
        else:
            state = f"waiting to be restarted: {watched.reason}" if watched.reason else "waiting to be started"
        current = report is not None and watched.handle is not None and report.pid == watched.handle.pid
        return {
            "role": name,
            "pid": watched.handle.pid if watched.handle is not None else None,
            "host": report.host if report is not None else None,
            "address": report.address if report is not None else None,
            "restarts": watched.restarts,
            "heartbeat_age_s": None if known.heard_s is None else round(self.now_s - known.heard_s, 2),
            "state": report.state if current and report is not None and not watched.is_done else state,
            "metrics": report.metrics if report is not None else {},
        }

    def _sum(self, name: str) -> float:
        return sum(role.total(name) for role in self.roles.values())
