"""What each figure of the replay is: unit and meaning, declared here once."""

from __future__ import annotations

from typing import NamedTuple


class Metric(NamedTuple):
    """A figure's declaration."""

    unit: str
    meaning: str


METRICS: dict[str, Metric] = {
    "replay.size": Metric("transitions", "held now"),
    "replay.inserted": Metric("transitions", "stored since the start of the run: size + evicted"),
    "replay.sampled": Metric("transitions", "delivered to the learner"),
    "replay.evicted": Metric("transitions", "dropped, the oldest first, to make room"),
    "replay.received": Metric("transitions", "that arrived, each counted once: inserted + refused"),
    "replay.refused": Metric("transitions", "of inserts that were refused, for values or shapes that are wrong"),
    "replay.refused_messages": Metric("messages", "refused for any reason"),
    "replay.updated_priorities": Metric("items", "that got a new priority"),
    "replay.late_priorities": Metric("items", "new priorities for items that were evicted already"),
    "replay.refused_priorities": Metric("items", "new priorities that were not finite"),
    "replay.samples_per_insert": Metric("1", "how often each transition was sampled, since the law was last set"),
    "replay.balance": Metric("samples", "earned by inserts and not taken yet; the limiter keeps it in its band"),
    "replay.policy_lag": Metric("updates", "that the weights which flew an arriving insert are behind; running mean"),
    "replay.sampled_lag": Metric("updates", "the same for sampled items, which have lain in the replay; running mean"),
    "replay.item_age": Metric("transitions", "inserted since a sampled item was; running mean"),
    "replay.actors": Metric("actors", "that ever inserted"),
    "replay.greatest_inserted_share": Metric("1", "share of the actor that inserted most"),
    "replay.greatest_sampled_share": Metric("1", "share of the actor whose items were sampled most"),
    "replay.alpha": Metric("1", "exponent of the priorities now"),
    "replay.beta": Metric("1", "exponent of the importance weights now"),
    "replay.mb": Metric("MB", "memory of buffer and sum tree, of 1e6 bytes"),
    "replay.duplicates": Metric("inserts", "that came a second time"),
    "replay.out_of_turn": Metric("inserts", "that came before an earlier one, or beyond the window; they come again"),
    "replay.undelivered": Metric("messages", "whose receiver was gone or took nothing more"),
    "replay.queued_inserts": Metric("inserts", "that wait to be stored"),
    "replay.queued_requests": Metric("requests", "for batches that wait"),
    "replay.snapshots": Metric("files", "written while serving"),
    "replay.failed_snapshots": Metric("files", "that could not be written"),
    "replay.idle_s": Metric("s", "spent waiting for messages"),
    "replay.receive_s": Metric("s", "spent receiving and checking messages"),
    "replay.insert_s": Metric("s", "spent storing"),
    "replay.sample_s": Metric("s", "spent drawing and sending batches"),
    "replay.update_s": Metric("s", "spent on new priorities"),
}

WRITER_METRICS: dict[str, Metric] = {
    "writer.sent": Metric("transitions", "handed over to be sent"),
    "writer.acknowledged": Metric("transitions", "stored, says the server"),
    "writer.refused": Metric("transitions", "refused, says the server"),
    "writer.resent": Metric("inserts", "sent again after a silence"),
    "writer.unacknowledged": Metric("inserts", "that the server has not answered for"),
    "writer.refused_messages": Metric("messages", "from the server that were no messages"),
}

READER_METRICS: dict[str, Metric] = {
    "reader.received": Metric("batches", "received"),
    "reader.ready": Metric("batches", "that lie ready"),
    "reader.waited_s": Metric("s", "that the learner spent waiting for a batch"),
    "reader.asked_again": Metric("requests", "sent again after a silence"),
    "reader.dropped_updates": Metric("updates", "of priorities that could not be sent"),
    "reader.refused_messages": Metric("messages", "from the server that were no messages"),
}
