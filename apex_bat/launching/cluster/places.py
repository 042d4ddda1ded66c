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
from apex_bat.launching.cluster.kept import Kept, Placer

PATIENCE_S = 3.0
"""How long replay, learner or evaluator may be without a place until actors leave theirs."""
ROOM_PERIOD_S = 2.0
"""Between two questions whether places are short, and between two actors that leave theirs."""
CLOSE_S = 5.0
"""How long the end waits for a question that is under way: a head that is gone does not answer it."""
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
        self._is_short, self._room_due_s = False, 0.0
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
                self._make_room(time.monotonic())
                self._place_all(time.monotonic())
                self._tell()
        except Exception as error:  # whatever it is: no role would get a place any more
            _log.exception("failed")
            self._fail(error)

    def _place_all(self, now_s: float) -> None:
        with self._lock:
            wanted = [kept for kept in self._kept.values() if self._wants_place(kept) and now_s >= kept.not_before_s]
        for kept in wanted:
            remote = self._placer.place(kept.role)
            with self._lock:
                is_current = self._kept.get(kept.role.name) is kept and not self._is_closed.is_set()
                if not (is_current and self._wants_place(kept)):
                    remote.dismiss()
                    continue
                kept.remote = remote
                kept.ask("site", versions_here(), kept.role)

    def _wants_place(self, kept: Kept) -> bool:
        is_held = self._is_short and kept.role.kind == "actor"
        return kept.remote is None and not is_held and not kept.placed.is_over

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
            victim.leave_place("its place went to a role without which nothing is learned")
