"""Finding places for keepers: a thread that asks the cluster for them, and takes them from actors when others lack one.

A thread of its own, because what is asked of the cluster's head may take long, and meanwhile the looks at the keepers,
on which all leases hang, must go on. No call to the cluster is made under the lock.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping

from apex_bat.launching.cluster.keeper import versions_here
from apex_bat.launching.cluster.kept import Kept, Placer, with_next

PATIENCE_S = 3.0
"""How long replay, learner or evaluator may be without a place until actors leave theirs."""
ROOM_PERIOD_S = 2.0
"""Between two questions whether places are short, and between two actors that leave theirs."""
CLOSE_S = 5.0
"""How long the end waits for a question that is under way: a head that is gone does not answer it."""
SILENT_S = 2.0
"""After how long a silence a next place is looked for: to find one and start a keeper there takes seconds."""
ASK_AFTER_S, ASK_PERIOD_S, MOST_REFUSALS = 1.0, 0.5, 3
"""After how long a silence the keeper's node is asked itself, how often, and how many refusals are believed."""
OTHERWISE_S = 15.0
"""How long a place is first asked for in one way: away from a doubtful node, or the reserved one, or any other. Each
further time takes twice as long, for a keeper may only be slow to start."""
_LOOK_S = 0.05
_log = logging.getLogger(__name__)


class Places:
    """Finds places for keepers, until it is closed."""

    def __init__(
        self,
        placer: Placer,
        kept: Mapping[str, Kept],
        lock: threading.Lock,
        tell: Callable[[], None],
        fail: Callable[[Exception], None],
    ) -> None:
        """Starts nothing yet.

        Args:
            placer: what makes keepers.
            kept: the keepers by role; grows and changes under the lock.
            lock: of all that the keepers' threads share.
            tell: called again and again; may take long.
            fail: told of what ends the thread.
        """
        self._placer, self._kept, self._lock = placer, kept, lock
        self._tell, self._fail = tell, fail
        self._is_short, self._room_due_s, self._ask_due_s = False, 0.0, 0.0
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="places", daemon=True)

    def start(self) -> None:
        """Starts the thread."""
        self._thread.start()

    def close(self) -> None:
        """Ends the thread; a keeper that it still makes is dismissed."""
        self._is_closed.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            while not self._is_closed.wait(_LOOK_S):
                if time.monotonic() >= self._ask_due_s:
                    self._ask_due_s = time.monotonic() + ASK_PERIOD_S
                    self._ask_nodes(time.monotonic())
                    self._ask_otherwise(time.monotonic())
                self._look_ahead(time.monotonic())
                self._make_room(time.monotonic())
                self._place_all(time.monotonic())
                self._tell()
        except Exception as error:  # whatever it is: no role would get a place any more
            _log.exception("failed")
            self._fail(error)

    def _ask_nodes(self, now_s: float) -> None:
        """Asks the nodes of silent keepers, of whose loss Ray tells after 12 s at the earliest, by its defaults."""
        with self._lock:
            silent = [kept for kept in self._kept.values() if self._is_silent(kept, now_s, ASK_AFTER_S)]
            nodes = {kept.doubtful_node for kept in silent} - {""}
        fates = self._placer.fates(nodes) if nodes else {}
        now_s = time.monotonic()
        with self._lock:
            for kept in self._kept.values():
                if kept not in silent:
                    kept.num_refusals = 0
            for kept in silent:
                is_refused = fates.get(kept.doubtful_node) == "refusing" and self._is_silent(kept, now_s, ASK_AFTER_S)
                kept.num_refusals = kept.num_refusals + 1 if is_refused else 0
                if kept.num_refusals >= MOST_REFUSALS:
                    _log.warning("%s: its node refuses connections: Ray has ended there", kept.role.name)
                    kept.lose("its node refuses connections")

    def _ask_otherwise(self, now_s: float) -> None:
        """Asks in another way for places that were asked for in vain."""
        with self._lock:
            everyone = with_next(self._kept.values())
            waiting = [kept for kept in everyone if kept.away_from or self._placer.reserves(kept.role)]
            waiting = [kept for kept in waiting if self._impatience(kept, now_s) > 0.5]
        if not waiting:
            return
        nodes = {kept.away_from for kept in waiting} - {""}
        fates = self._placer.fates(nodes) if nodes else {}
        is_short = self._placer.is_short()
        with self._lock:
            for kept in waiting:
                share = self._impatience(kept, now_s)  # none if a place was found meanwhile
                is_late = share > (0.5 if fates.get(kept.away_from) == "removed" else 1.0)
                is_in_group = kept.is_reserved and not kept.away_from
                if is_late and is_in_group == is_short:  # where there is none, or not where there is one
                    kept.ask_anew(now_s, is_reserved=not is_short)

    def _impatience(self, kept: Kept, now_s: float) -> float:
        """Returns how long a place has been asked for in one way, as a share of the longest that this may take."""
        return kept.waits_s(now_s) / (OTHERWISE_S * 2.0**kept.num_asks)

    def _look_ahead(self, now_s: float) -> None:
        """Asks for a next place for what is lost or silent, and gives it back when that is heard again."""
        with self._lock:
            for kept in self._kept.values():
                if not (kept.is_lost or self._is_silent(kept, now_s, SILENT_S)):
                    kept.drop_next()
                elif kept.role.kind == "actor" or kept.placed.is_over:  # what is there already stays for the next life
                    continue
                elif kept.next is None or (kept.next.is_lost and now_s - kept.next.asked_s > PATIENCE_S):
                    kept.begin_next(now_s)

    def _is_silent(self, kept: Kept, now_s: float, least_s: float) -> bool:
        return kept.site is not None and not kept.is_lost and kept.hearing.silent_s(now_s) > least_s

    def _place_all(self, now_s: float) -> None:
        with self._lock:
            everyone = with_next(self._kept.values())
            wanted = [kept for kept in everyone if self._wants_place(kept) and now_s >= kept.not_before_s]
        for kept in wanted:
            remote = self._placer.place(kept.role, kept.away_from, is_reserved=kept.is_reserved)
            with self._lock:
                is_current = kept in with_next(self._kept.values()) and not self._is_closed.is_set()
                if not (is_current and self._wants_place(kept)):
                    remote.dismiss()
                    continue
                kept.remote = remote
                kept.ask("site", versions_here(), kept.role)

    def _wants_place(self, kept: Kept) -> bool:
        is_held = self._is_short and kept.role.kind == "actor"
        is_over = kept.placed.is_over and not kept.is_in_advance
        return kept.remote is None and not (is_held or is_over or kept.is_lost)

    def _make_room(self, now_s: float) -> None:
        """Takes places from actors while the cluster has none for a role without which nothing is learned."""
        with self._lock:
            waiting = [kept for kept in self._kept.values() if kept.role.kind != "actor" and kept.has_no_place]
            since_s = min((kept.asked_s for kept in waiting), default=now_s)
        if now_s - since_s <= PATIENCE_S:
            self._is_short = False
            return
        if now_s < self._room_due_s:
            return
        self._room_due_s = now_s + ROOM_PERIOD_S
        self._is_short = self._placer.is_short()
        if self._is_short:
            with self._lock:
                self._take_a_place()

    def _take_a_place(self) -> None:
        """Takes the place of the last actor; not of the first one, whose place nobody else could have."""
        actors = [kept for kept in self._kept.values() if kept.role.kind == "actor"]
        for kept in actors:
            if kept.has_no_place:  # or it would take what becomes free
                kept.dismiss()
                kept.remote = None
                kept.under_way.clear()
        further = (kept for kept in reversed(actors) if kept.role.number > 0)
        victim = next((kept for kept in further if kept.site is not None and not kept.is_lost), None)
        if victim is not None:
            _log.warning("%s: leaves its place to a role that has none", victim.role.name)
            victim.lose("its place went to a role without which nothing is learned")
