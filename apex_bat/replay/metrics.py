"""What each figure of the replay is: unit and meaning, declared here once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apex_bat.transport.refusals import REASONS

PRIORITY_BINS = 16
PRIORITY_EDGES = np.logspace(-3.0, 1.0, PRIORITY_BINS + 1)
"""Priorities from the default `replay.priority_epsilon`, the least there is, to the default clip; 4 bins a decade."""


class Metric(NamedTuple):
    """A figure's declaration."""

    unit: str
    meaning: str


SHARED_ACTORS = 16
"""Actors whose shares are reported: a row for each of thousands would be read by nobody."""


def declared_name(name: str) -> str:
    """Returns the name under which a reported figure is declared: that of an actor's share without the actor."""
    shares = ("replay.inserted_share.", "replay.sampled_share.")
    return next((share + "ACTOR" for share in shares if name.startswith(share)), name)


METRICS: dict[str, Metric] = {
    "replay.size": Metric("transitions", "held now"),
    "replay.inserted": Metric("transitions", "stored since the start of the run: size + evicted"),
    "replay.sampled": Metric(
        "transitions", "delivered to the learner, as the law counts: with several servers, shared out by inserts"
    ),
    "replay.drawn": Metric("transitions", "drawn for the learner: with several servers, shared out by priorities"),
    "replay.evicted": Metric("transitions", "dropped, the oldest first, to make room"),
    "replay.received": Metric("transitions", "that arrived, each counted once: inserted + refused"),
    "replay.refused": Metric("transitions", "of inserts that were refused, for values or shapes that are wrong"),
    "replay.refused_messages": Metric("messages", "and connections refused for any reason"),
    **{f"replay.refused_messages.{reason}": Metric("messages", meaning) for reason, meaning in REASONS.items()},
    "replay.ended_connections": Metric("connections", "that were open and ended: orderly, lost, or closed by us"),
    "replay.updated_priorities": Metric("items", "that got a new priority"),
    "replay.late_priorities": Metric("items", "new priorities for items that were evicted already"),
    "replay.refused_priorities": Metric("items", "new priorities that were not finite"),
    "replay.samples_per_insert": Metric("1", "how often each transition was sampled, since the law was last set"),
    "replay.wanted_samples_per_insert": Metric("1", "what the law now asks for: the setting, or what `adjust` made it"),
    "replay.balance": Metric("samples", "earned by inserts and not taken yet; the limiter keeps it in its band"),
    "replay.policy_lag": Metric("updates", "that the weights which flew an arriving insert are behind; running mean"),
    "replay.sampled_lag": Metric("updates", "the same for sampled items, which have lain in the replay; running mean"),
    "replay.item_age": Metric("transitions", "inserted since a sampled item was; running mean"),
    "replay.actors": Metric("actors", "that ever inserted"),
    "replay.greatest_inserted_share": Metric("1", "share of the actor that inserted most"),
    "replay.inserted_share.ACTOR": Metric("1", "share of this actor, one of the 16 sampled most, in the inserted"),
    "replay.sampled_share.ACTOR": Metric("1", "its share in the sampled; above the other if its priorities stand out"),
    "replay.greatest_sampled_share": Metric("1", "share of the actor whose items were sampled most"),
    "replay.alpha": Metric("1", "exponent of the priorities now"),
    "replay.beta": Metric("1", "exponent of the importance weights now"),
    **{
        f"replay.priority_hist.{k:02d}": Metric(
            "1",
            f"share of the items held whose priority, before the exponent, is {PRIORITY_EDGES[k]:.2g} to "
            f"{PRIORITY_EDGES[k + 1]:.2g}" + (", or less" if k == 0 else ", or more" if k == PRIORITY_BINS - 1 else ""),
        )
        for k in range(PRIORITY_BINS)
    },
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
    "reader.dropped_updates": Metric("updates", "of priorities that could not be sent, to one server at least"),
    "reader.refused_messages": Metric("messages", "from the server that were no messages"),
    "reader.servers_away": Metric("servers", "of several that do not answer now; batches come from the others"),
    "reader.parts_drawn_again": Metric("parts", "of batches whose server was lost, drawn from the others"),
    "reader.misplaced_share": Metric(
        "1", "of the draws that would have gone to another server by the totals of the moment of the draw; running mean"
    ),
}
