"""Keeps the number of samples per insert near a wanted ratio, by making the faster side wait.

The law (Reverb, Cassirer et al. 2021, section 3.4). With I transitions inserted and S sampled so far,

    balance = samples_per_insert * (I - min_size) - S        (in samples)

Samples wait while I < min_size, or while they would take the balance below -error_buffer. Inserts wait, once
I >= min_size, while they would take it above +error_buffer. The faster side is thus held back, whichever it is, and the
ratio S / (I - min_size) tends to samples_per_insert.

Both would wait for each other for ever if the band were narrower than one insert and one sample together:
an insert of i transitions waits above error_buffer - samples_per_insert * i, a sample of s below s - error_buffer, and
the two regions overlap unless 2 error_buffer >= samples_per_insert * i + s. Such a band is refused.
"""

from __future__ import annotations

from typing import NamedTuple

UNBOUNDED = 1 << 40
"""Samples earned where there is no law."""


class LimiterCounters(NamedTuple):
    """What a snapshot must keep so that the law goes on where it stopped."""

    inserted: int
    sampled: int
    origin_inserted: int
    """Inserts at which the balance starts to count: min_size, or where the law was last changed."""
    origin_sampled: int


class RateLimiter:
    """The law above and its counters.

    Args:
        samples_per_insert: how often each transition is to be sampled.
        min_size: transitions inserted before the first sample.
        error_buffer: half-width of the band, samples; None: a tenth of min_size * samples_per_insert, or the least
            with which both sides progress.
        largest_insert: most transitions of one insert.
        largest_sample: most transitions of one sample.
        never_block: Ape-X's mode: only min_size is kept, the ratio is whatever the machine gives.
        shards: servers whose bands make up `replay.error_buffer`; errors name the setting's figure.

    Raises:
        ValueError: both sides could come to wait for each other.
    """

    def __init__(
        self,
        samples_per_insert: float,
        min_size: int,
        error_buffer: float | None,
        *,
        largest_insert: int,
        largest_sample: int,
        never_block: bool = False,
        shards: int = 1,
    ) -> None:
        self.min_size = min_size
        self._shards = shards
        self.never_block = never_block
        self._largest_insert = largest_insert
        self._largest_sample = largest_sample
        self.inserted = 0
        self.sampled = 0
        self._origin_inserted = min_size
        self._origin_sampled = 0
        self._configured_buffer = error_buffer
        self._set_law(samples_per_insert, error_buffer)

    def refusal(self, num_transitions: int) -> str:
        """Returns why an insert of so many transitions would wait for ever; empty where it would not."""
        if self.never_block or num_transitions <= self._largest_insert:
            return ""
        return (
            f"{num_transitions} transitions at once; with these settings an actor sends at most {self._largest_insert}"
            ", and the band of the rate limiter is made for that: give all hosts the same settings"
        )

    @property
    def law(self) -> tuple[float, float]:
        """`samples_per_insert` and `error_buffer` now."""
        return self.samples_per_insert, self.error_buffer

    @property
    def balance(self) -> float:
        """Samples that inserts have earned and nobody has taken yet; negative: taken in advance."""
        earned = self.samples_per_insert * (self.inserted - self._origin_inserted)
        return earned - (self.sampled - self._origin_sampled)

    @property
    def measured_ratio(self) -> float:
        """Samples per insert since the law was last set; 0 before the first."""
        inserts = self.inserted - self._origin_inserted
        return (self.sampled - self._origin_sampled) / inserts if inserts > 0 else 0.0

    def can_insert(self, num_transitions: int) -> bool:
        """Whether an insert of so many transitions need not wait."""
        if self.never_block or self.inserted < self.min_size:
            return True
        return self.balance + self.samples_per_insert * num_transitions <= self.error_buffer

    @property
    def earned(self) -> int:
        """Samples that need not wait now, if they come one by one; without a law, as many as anybody could want."""
        if self.inserted < self.min_size:
            return 0
        return UNBOUNDED if self.never_block else max(0, int(self.balance + self.error_buffer))

    @property
    def holds_back_inserts(self) -> bool:
        """Whether the largest insert would have to wait now."""
        return not self.can_insert(self._largest_insert)

    def can_sample(self, num_transitions: int) -> bool:
        """Whether a sample of so many transitions need not wait."""
        if self.inserted < self.min_size:
            return False
        return self.never_block or self.balance - num_transitions >= -self.error_buffer

    def count_insert(self, num_transitions: int) -> None:
        """Counts transitions that were inserted."""
        self.inserted += num_transitions

    def count_sample(self, num_transitions: int) -> None:
        """Counts transitions that were sampled."""
        self.sampled += num_transitions

    def change(self, samples_per_insert: float, error_buffer: float | None = None) -> None:
        """Sets another law, which holds from now on: what was owed under the old one is forgotten.

        Without `error_buffer` the band of the constructor holds on where it is wide enough for the new ratio.

        Raises:
            ValueError: both sides could come to wait for each other; the old law stays.
        """
        configured = self._configured_buffer
        if error_buffer is None and configured is not None and configured >= self._least_buffer(samples_per_insert):
            error_buffer = configured
        self._set_law(samples_per_insert, error_buffer)
        self._origin_inserted = max(self.inserted, self.min_size)
        self._origin_sampled = self.sampled

    def waiting_reason(self) -> str:
        """Returns whom the held-back side waits for; empty when the largest insert and sample may both go on."""
        if self.inserted < self.min_size:
            return f"waiting for actors: {self.min_size - self.inserted} transitions are missing for the first sample"
        if not self.can_sample(self._largest_sample):
            return f"the learner waits for actors: each transition was sampled {self.samples_per_insert:g} times"
        if not self.can_insert(self._largest_insert):
            return f"actors wait for the learner: {self.balance:.0f} samples are due"
        return ""

    def counters(self) -> LimiterCounters:
        """Returns what `restore` needs."""
        return LimiterCounters(self.inserted, self.sampled, self._origin_inserted, self._origin_sampled)

    def restore(self, counters: LimiterCounters) -> None:
        """Goes on where `counters` were taken."""
        self.inserted, self.sampled, self._origin_inserted, self._origin_sampled = counters

    def _set_law(self, samples_per_insert: float, error_buffer: float | None) -> None:
        if samples_per_insert <= 0 or self.min_size < 1:
            raise ValueError("samples_per_insert must be above 0 and min_size at least 1")
        least = self._least_buffer(samples_per_insert)
        if error_buffer is None:
            error_buffer = max(0.1 * self.min_size * samples_per_insert, least)
        if error_buffer < least and not self.never_block:
            servers = f", shared out over {self._shards} servers" if self._shards > 1 else ""
            raise ValueError(
                f"replay.error_buffer {self._shards * error_buffer:g} is too narrow{servers}: with inserts of up to "
                f"{self._largest_insert} transitions, {samples_per_insert:g} samples each, and batches of "
                f"{self._largest_sample}, actors and learner could wait for each other for ever; "
                f"give at least {self._shards * least:g}"
            )
        self.samples_per_insert = samples_per_insert
        self.error_buffer = error_buffer

    def _least_buffer(self, samples_per_insert: float) -> float:
        return (samples_per_insert * self._largest_insert + self._largest_sample) / 2
