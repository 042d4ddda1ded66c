"""How a batch is shared out over several replay servers: what each draws, what each is charged, how parts are joined.

Pure functions. The law of samples per insert cannot be kept by what each server draws: draws follow priorities, so a
server with less priority for each insert would fall behind, and hold its actors back, while another starved the
learner. So the two are kept apart. A server *draws* in proportion to its total of priorities; it is *charged*, by its
rate limiter, in proportion to what its inserts have earned. All charges of a batch add up to its size, so the sum of
the servers' balances is that of one server with all the inserts, and each keeps its own in its band.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apex_bat.experience import Batch, States
from apex_bat.transport.messages import Standing


class DrawnPart(NamedTuple):
    """What one server gave to a batch."""

    server: int
    batch: Batch
    standing: Standing
    """Of the server when it drew."""
    chance: float
    """Probability with which a draw of the whole batch was given to the server."""


def drawn_sizes(totals: Sequence[float], num_draws: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Returns how many of `num_draws` draws fall to each server, int64 (servers,).

    The draws are stratified over all servers together as they are within one (`SumTree.sample`): one from each of
    `num_draws` equal parts of the sum of totals. The mean of each number is exactly its server's share.
    """
    if not num_draws:
        return np.zeros(len(totals), np.int64)
    ends = np.cumsum(totals)
    targets = (np.arange(num_draws) + generator.random(num_draws)) * (ends[-1] / num_draws)
    owners = np.searchsorted(ends, np.minimum(targets, np.nextafter(ends[-1], 0.0)), side="right")
    sizes: NDArray[np.int64] = np.bincount(owners, minlength=len(ends)).astype(np.int64)
    return sizes


def charges(earned: Sequence[int], amount: int) -> NDArray[np.int64]:
    """Returns what each server is charged, int64 (servers,), `amount` together: from the greatest down to one level.

    Args:
        earned: samples that each server's law lets out. No server is charged more while they add up to `amount`.
        amount: samples.
    """
    wealth = np.array(earned, np.int64)
    order = np.argsort(-wealth, kind="stable")
    richest = wealth[order]
    levels = (np.cumsum(richest) - amount) / np.arange(1, len(richest) + 1)
    next_ones = np.append(richest[1:], -(1 << 62))
    level = levels[np.argmax(levels >= next_ones)]  # the first that leaves the rest untouched
    exact = np.maximum(wealth - level, 0.0)
    taken: NDArray[np.int64] = np.floor(exact).astype(np.int64)
    rest = amount - int(taken.sum())
    taken[np.argsort(taken - exact, kind="stable")[:rest]] += 1
    return taken


def joined(parts: Sequence[DrawnPart], num_servers: int) -> Batch:
    """Returns the batch of some parts; item number n of server k of K appears as n K + k.

    The importance weights are those of the probability by which each item was really drawn: the chance of its server,
    which may follow totals that were some batches old, times its share in the server's total at the draw. So they are
    right however old the totals were. As with one server they are divided by the greatest of the batch, which is why
    the number of transitions held by all servers plays no part.
    """
    # The server's are (held * share)^-beta / largest; these are to be (chance * share)^-beta.
    raw = np.concatenate(
        [
            batch.weights * (standing.largest_weight * (chance / standing.held) ** -standing.beta)
            for _, batch, standing, chance in parts
        ]
    )
    batches = [part.batch for part in parts]
    return Batch(
        items=np.concatenate([part.batch.items * num_servers + part.server for part in parts]),
        weights=(raw / raw.max()).astype(np.float32),
        states=_states([batch.states for batch in batches]),
        actions=np.concatenate([batch.actions for batch in batches]),
        rewards=np.concatenate([batch.rewards for batch in batches]),
        discounts=np.concatenate([batch.discounts for batch in batches]),
        next_states=_states([batch.next_states for batch in batches]),
    )


def misplaced_share(chances: NDArray[np.float64], totals: Sequence[float]) -> float:
    """Returns the share of draws that went to another server than by the totals of their moment: half the distance."""
    now = np.array(totals, np.float64)
    return float(0.5 * np.abs(chances / chances.sum() - now / now.sum()).sum())


def _states(states: Sequence[States]) -> States:
    return States(np.concatenate([s.echoes for s in states]), np.concatenate([s.actions for s in states]))
