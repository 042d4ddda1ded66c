"""The keepers of a run on a cluster: a thread looks at each twice a second, starts what is due and passes news on.

A thread of its own, because the leases of all roles hang on it: neither a slow disk under the launcher nor a slow head
of the cluster must end them. It knows nothing of Ray; whoever makes keepers and carries the calls to them is handed in.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path
from types import TracebackType

import msgspec

from apex_bat.config import Config
from apex_bat.launching.cluster.directory import Directory, new_generation
from apex_bat.launching.cluster.keeper import Look, Site, versions_here
from apex_bat.launching.cluster.kept import MOST_FAILED_STARTS, Kept, LostError, Placer, Ticket, with_next
from apex_bat.launching.cluster.placed import Placed
from apex_bat.launching.cluster.placement import ClusterError
from apex_bat.launching.cluster.places import Places
from apex_bat.launching.processes import has_reserve, remove_unfinished, threads_of
from apex_bat.roles.orders import line_of
from apex_bat.roles.plan import Role
from apex_bat.roles.process import ADDRESSES
from apex_bat.storage import StorageError, write_text
from apex_bat.transport.reports import ReportCollector
from apex_bat.transport.security import Keys

LOOK_S = 0.5
"""Between two looks at a keeper."""
_WAIT_S = 0.1
_log = logging.getLogger(__name__)


class Fleet:
    """Starts roles in places of a cluster; as a context, its thread runs while the block lasts."""

    def __init__(self, config: Config, run: Path, collector: ReportCollector, keys: Keys, placer: Placer) -> None:
        """Takes what every role is told, and what makes keepers."""
        self._config, self._run_folder, self._collector = config, run, collector
        self._keys, self._placer = keys, placer
        self._directory = Directory(collector.address, config.replay.shards)
        self._kept: dict[str, Kept] = {}
        self._num_lives = 0
        self._written_version = -1
        self._lock = threading.Lock()
        self._is_closed = threading.Event()
        self._error: Exception | None = None
        self._places = Places(placer, self._kept, self._lock, self._write_addresses, self._fail)
        self._thread = threading.Thread(target=self._run, name="fleet", daemon=True)

    def __enter__(self) -> Fleet:
        self._thread.start()
        self._places.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._is_closed.set()
        self._thread.join()
        self._places.close()
        for kept in self._kept.values():
            kept.dismiss()
            kept.drop_next()

    def start(self, role: Role, incarnation: int, flown_steps: int) -> Placed:
        """Starts a role where it was before, if its keeper lives, or in a new place; returns at once.

        Raises:
            ClusterError: a thread has failed.
        """
        if self._error is not None:
            raise ClusterError(f"the thread that looks at the keepers failed: {self._error!r}")
        self._clean_after(role)
        with self._lock:
            kept = self._kept.get(role.name)
            if kept is None or kept.is_lost or kept.hearing.is_over(time.monotonic()):
                kept = self._kept[role.name] = self._next_kept(role, kept)
            self._num_lives += 1
            kept.placed = Placed(
                role, self._num_lives, self._placer.asks(role), self._config, kept.hearing, kept.orderer()
            )
            kept.incarnation, kept.flown_steps, kept.site = incarnation, flown_steps, None
            kept.asked_s = time.monotonic()
            kept.ask("site", versions_here(), role)
            return kept.placed

    @property
    def is_waiting(self) -> bool:
        """Whether a role has no place yet."""
        with self._lock:
            return any(kept.has_no_place for kept in self._kept.values())

    def _next_kept(self, role: Role, former: Kept | None) -> Kept:
        """Returns the keeper found in advance, or one to be made when all that ran on the former one has ended."""
        lease_s, now_s = self._config.cluster.lease_s, time.monotonic()
        if former is None:
            return Kept(role, lease_s, now_s)
        former.dismiss()
        if former.next is not None and not former.next.is_lost:
            former.next.is_in_advance = False
            return former.next
        is_awaited = role.kind != "actor" and former.hearing.lost_s is not None
        return Kept(role, lease_s, now_s, former.hearing.gone_s() if is_awaited else 0.0, former.doubtful_node)

    def _clean_after(self, role: Role) -> None:
        """Removes what the former life of a role was writing: a keeper that is late would remove what the next writes.

        Where each host is a container of its own, another role may have the same process number.
        """
        kept = self._kept.get(role.name)
        if kept is None or role.kind == "actor" or not kept.placed.pid:
            return
        others = {other.placed.pid for other in self._kept.values() if other is not kept and not other.placed.is_over}
        if kept.placed.pid not in others:
            remove_unfinished(self._run_folder, role, kept.placed.pid)

    def _write_addresses(self) -> None:
        """Notes where the servers listen, for `adjust`, which can enter with keys only."""
        with self._lock:
            version, addresses = self._directory.version, self._directory.addresses_for(Role("actor", 0), 0)
        if version == self._written_version or addresses is None or not self._config.transport.keys:
            return
        self._written_version = version
        try:
            write_text(self._run_folder / ADDRESSES, msgspec.json.encode(addresses).decode(), mode=0o600)
        except StorageError as error:
            _log.warning("`apex-bat adjust` will not find the run: %s", error)

    def _run(self) -> None:
        try:
            self._look_after_all()
        except Exception as error:  # whatever it is: nobody would hear of the roles any more
            _log.exception("failed")
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        self._error = error
        for kept in self._kept.values():
            kept.placed.take_loss(f"the launcher's thread failed: {error!r}")

    def _look_after_all(self) -> None:
        while not self._is_closed.is_set():
            with self._lock:
                everyone = with_next(self._kept.values())
                for kept in everyone:
                    self._advance(kept)
                owners = {ticket: kept for kept in everyone for ticket in kept.under_way}
            for ticket, answer in self._placer.answers(list(owners), _WAIT_S):
                with self._lock:
                    self._take(owners[ticket], ticket, answer)

    def _advance(self, kept: Kept) -> None:
        """Starts the role if it is due, and looks at the keeper if that is."""
        now_s = time.monotonic()
        placed = kept.placed
        if kept.is_lost or (kept.hearing.heard_s is None and kept.site is None):
            return
        has_place = kept.site is not None and not (kept.is_useless or kept.is_in_advance)
        if has_place and placed.can_begin and self._begin(kept, placed):
            kept.look_due_s = now_s + LOOK_S
        elif now_s >= kept.look_due_s and all(method != "look" for method, _ in kept.under_way.values()):
            kept.look_due_s = now_s + LOOK_S
            kept.ask("look", kept.hearing.seen, self._news_for(kept))

    def _begin(self, kept: Kept, placed: Placed) -> bool:
        """Orders the role to be started; returns whether all that it needs has a place."""
        role, generation = placed.role, new_generation()
        addresses = self._directory.addresses_for(role, generation)
        if addresses is None:
            return False
        self._collector.generations[role.name] = generation
        kept.told_version = self._directory.version
        keys = self._keys if role.kind in ("replay", "learner") else self._keys.of_client()
        placed.begin()
        kept.ask(
            "start", placed.life, role, kept.incarnation, threads_of(role, self._config),
            kept.flown_steps, line_of(addresses, keys),
            has_reserve(role, self._config),
        )  # fmt: skip
        return True

    def _news_for(self, kept: Kept) -> bytes | None:
        """Returns orders for a role that does not know the newest addresses; None if there is no news."""
        placed = kept.placed
        if placed.waiting or kept.is_in_advance or kept.told_version == self._directory.version:
            return None
        addresses = self._directory.addresses_for(placed.role, self._collector.generations[placed.role.name])
        if addresses is None:
            return None
        kept.told_version = self._directory.version
        return line_of(addresses)

    def _take(self, kept: Kept, ticket: Ticket, answer: object) -> None:
        asked = kept.under_way.pop(ticket, None)
        if asked is None:
            return  # its keeper was dismissed meanwhile
        method, life = asked
        placed = kept.placed
        if isinstance(answer, LostError):
            if not kept.is_lost:  # else it was we who ended it
                kept.is_known_lost = True
                _log.warning("%s: its keeper is lost: %s", placed.role.name, answer)
                kept.lose(str(answer))
        elif isinstance(answer, Look):
            kept.hearing.take(time.monotonic(), answer.number)
            if not kept.is_in_advance:
                placed.take_look(answer)
        elif method == "look":  # one that did not come through: the news that it carried goes again
            kept.told_version = -1
        elif life != placed.life:
            return
        elif kept.is_in_advance and isinstance(answer, Exception):
            kept.lose(str(answer))
        elif kept.is_in_advance and isinstance(answer, Site):  # the life that begins there asks again
            kept.site = answer
            kept.hearing.take(time.monotonic())
            if has_reserve(kept.role, self._config) and not answer.problem:
                kept.ask("prepare", kept.role, threads_of(kept.role, self._config))
        elif isinstance(answer, Exception):
            self._take_error(kept, placed, method, answer)
        elif isinstance(answer, Site):
            self._take_site(kept, placed, answer)
        elif method == "start" and isinstance(answer, int):
            kept.failed_starts = 0
            placed.take_start(answer)

    def _take_error(self, kept: Kept, placed: Placed, method: str, error: Exception) -> None:
        placed.take_error(error)
        kept.failed_starts += method in ("site", "start")
        if kept.failed_starts >= MOST_FAILED_STARTS:
            _log.warning("%s: could not be started %d times; leaves its place", placed.role.name, kept.failed_starts)
            kept.lose(str(error))

    def _take_site(self, kept: Kept, placed: Placed, site: Site) -> None:
        kept.site = site
        kept.hearing.take(time.monotonic())
        if site.problem and self._is_one_of_many(kept.role):
            _log.warning("%s on %s: %s; this place stays empty", placed.role.name, site.host, site.problem)
            kept.is_useless = True  # its keeper holds the place, or it would be found again
            placed.take_useless(site)
        elif placed.take_site(site):
            _log.info("%s: has a place on %s (%s)", placed.role.name, site.host, site.address)
            self._directory.settle(placed.role, f"tcp://{site.address}:{site.port}")

    def _is_one_of_many(self, role: Role) -> bool:
        """Whether another actor works, so that this one can be done without."""
        actors = (kept.placed for kept in self._kept.values() if kept.role.kind == "actor" and kept.role != role)
        return role.kind == "actor" and any(placed.pid and not placed.is_over for placed in actors)
