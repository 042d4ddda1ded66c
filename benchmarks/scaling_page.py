"""The page docs/scaling.md, made from docs/results/bench_scaling.json.

Run `apex-bat bench scaling --json docs/results/bench_scaling.json` on a quiet machine, then
`python -m benchmarks.scaling_page > docs/scaling.md`; a test holds the page to the file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

from benchmarks.performance import RESULTS
from benchmarks.replay import Record
from benchmarks.scaling import SCALES, SETUPS, Scale, at_speed
from benchmarks.scaling_costs import CHUNK, costs_of
from benchmarks.scaling_model import Outcome

FILE = RESULTS / "bench_scaling.json"
PERIOD = 25  # updates between broadcasts of the weights, by default
RATIO = 8.0
BATCH = 64


def document(records: Sequence[Record]) -> str:
    """Returns the page, Markdown."""
    median = {str(record["name"]): float(record["median"]) for record in records}
    return "\n".join([_HEAD, *_costs(records), "", *_limits(records, median), "", _MODEL, *_beside(median), "", _AT,
                      *_scales(records, median), "", _FOLLOWS, _SHARDS]).rstrip() + "\n"  # fmt: skip


def _costs(records: Sequence[Record]) -> list[str]:
    costs = costs_of(records)
    median = {str(record["name"]): float(record["median"]) for record in records}
    rows = (
        ("an actor, for a step of one bat", costs.step_s * 1e6, "us"),
        (f"a server, for an insert of {CHUNK} transitions", costs.insert_s * 1e6, "us"),
        (f"a server, for a batch of {BATCH} and its new priorities", median["scaling.cost.batch_64_us"], "us"),
        ("a server, for a batch of 512 and its new priorities", median["scaling.cost.batch_512_us"], "us"),
        (f"the learner, for an update with {BATCH}", median["scaling.cost.update_64_us"], "us"),
        ("the learner, for an update with 512", median["scaling.cost.update_512_us"], "us"),
        (
            f"the learner's host, to take a batch of {BATCH} and send its priorities",
            median["scaling.cost.take_64_us"],
            "us",
        ),
        (
            "the learner's host, to take a batch of 512 and send its priorities",
            median["scaling.cost.take_512_us"],
            "us",
        ),
        ("a transition on the wire", median["scaling.wire.transition_bytes"], "B"),
        (f"a batch of {BATCH} on the wire", median["scaling.wire.batch_64_bytes"], "B"),
        ("the weights on the wire, to each actor", median["scaling.wire.weights_bytes"], "B"),
    )
    return ["| what | cost |", "|---|--:|", *(f"| {what} | {_number(value)} {unit} |" for what, value, unit in rows)]


def _limits(records: Sequence[Record], median: dict[str, float]) -> list[str]:
    costs = costs_of(records)
    actor, server = 1.0 / costs.step_s, CHUNK / costs.insert_s
    updates, fast = 1.0 / costs.learn_s(BATCH), 1.0 / at_speed(costs, 20.0).learn_s(BATCH)
    part_s = costs.request_s + BATCH * costs.item_s
    weights_mb = median["scaling.wire.weights_bytes"] / 1e6 / PERIOD
    return [
        "Each by itself, on a core of its own:",
        "",
        f"- An actor flies {_number(actor)} steps/s.",
        f"- A server stores {_number(server)} transitions/s, those of {_number(server / actor)} actors, or gives "
        f"{_number(1.0 / part_s)} batches of {BATCH} a second, those of {_number(1.0 / part_s / updates)} learners.",
        f"- The learner makes {_number(updates)} updates/s. At {RATIO:g} samples per insert that uses up "
        f"{_number(updates * BATCH / RATIO)} transitions/s: the work of {_number(updates * BATCH / RATIO / actor)} "
        f"actors. It is the first bottleneck: more actors than that wait for it, by the law of samples per insert.",
        f"- Weights go to every actor each {PERIOD} updates: {_number(weights_mb * updates)} MB/s an actor beside a "
        f"learner of one core. From one 20 times as fast 100 actors draw {_number(weights_mb * fast * 100)} MB/s: "
        f"then `learner.weights_period` is to grow with its speed, or the network is the bottleneck.",
    ]


def _beside(median: dict[str, float]) -> list[str]:
    lines = ["| samples per insert | actors | | predicted | measured | predicted / measured |",
             "|--:|--:|---|--:|--:|--:|"]  # fmt: skip
    for setup in SETUPS:
        for figure, words in (("steps_per_s", "steps/s"), ("updates_per_s", "updates/s")):
            predicted = median.get(f"scaling.predicted.{setup.name}.{figure}")
            measured = median.get(f"scaling.measured.{setup.name}.{figure}")
            if predicted is None or measured is None:
                continue
            lines.append(
                f"| {setup.samples_per_insert:g} | {setup.actors} | {words} | {_number(predicted)} | "
                f"{_number(measured)} | {predicted / measured:.2f} |"
            )
    return lines if len(lines) > 2 else ["Not measured yet."]


def _scales(records: Sequence[Record], median: dict[str, float]) -> list[str]:
    lines = ["| cores | servers | learner | batch | samples per insert | steps/s | updates/s | measured ratio | "
             "servers busy | actors held | core-hours a million steps | binds |",
             "|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|---|"]  # fmt: skip
    del records
    for scale in SCALES:
        if f"{scale.name}.steps_per_s" not in median:
            continue
        steps, updates, ratio, server, learner, held = (median[f"{scale.name}.{figure}"] for figure in Outcome._fields)
        law = "free" if scale.ratio is None else f"{scale.ratio:g}"
        lines.append(
            f"| {scale.cores:,} | {scale.servers} | x{scale.speed:g} | {scale.batch_size} | {law} | "
            f"{_number(steps)} | {_number(updates)} | "
            f"{_number(ratio)} | {server:.0%} | {held:.0%} | {_number(scale.cores / 3600 * 1e6 / steps)} | "
            f"{_binding(scale, server, learner, held)} |"
        )
    return lines


def _binding(scale: Scale, server_busy: float, learner_busy: float, actors_held: float) -> str:
    """Returns which part the others wait for."""
    if server_busy > 0.95:
        return "the servers" if scale.servers > 1 else "the server"
    if actors_held < 0.05:
        return "the actors"
    return "the learner" if learner_busy > 0.95 else "the law"


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


_HEAD = """# How it scales

Made by `python -m benchmarks.scaling_page` from `docs/results/bench_scaling.json`, which
`apex-bat bench scaling --json FILE` writes on a checkout. What one core does here is measured; what follows from it for
more cores than there are here is a model's word, and marked so.

## What each part costs

CPU of one shared virtual core, medians of three rounds, each part by itself.
"""

_MODEL = """## The model beside real runs

`benchmarks/scaling_model.py` simulates a run event by event: CPU of every role, cores shared evenly, the servers'
queues and turns, the actors' windows, the learner's prefetch, the law of samples per insert. It leaves out the network,
memory, the launcher and start-up. Real runs of 30 s of flight, the last 18 of them counted, medians
of three rounds, on the same two shared cores, defaults but for what the table names:
"""

_AT = """## On 10, 100 and 1,000 cores (predicted)

One core each for the learner and every server, the rest are actors of 16 bats. *x20* is a learner whose updates take a
twentieth of the time that they take this core, as on a GPU: assumed, not measured. What its host does to take batches
and to send priorities is as slow as here, and one after the other with the updates. *Free* is `replay.never_block`:
nobody waits, and the ratio is what comes. *Held* is the share of their time in which actors wait for room.
"""

_FOLLOWS = """\
With the learner of one core more actors buy nothing at the default of 8 samples per insert: they wait for it. With a
faster device the learner's host, which takes batches and sends priorities, and the server that gives them come to cost
as much as the update itself. Several servers do not lift that, because each takes part in every batch; larger batches
do, because most of what a batch of 64 costs host and server does not grow with its size. Servers beyond the first pay
for inserts, where few samples are drawn of each.
"""

_SHARDS = """## Several replay servers

`replay.shards = K` spreads the replay over K servers, each with its part of the capacity, of the first size and of the
band. Actors send their inserts to the servers in turn; the learner draws every batch from all of them as if they were
one: the number of draws from each is stratified by the servers' totals of priorities, so that an item's probability is
its priority over the sum of all servers. Totals are as old as a server's last answer; importance weights use the
probability by which each item was really drawn, and `reader.misplaced_share` tells how many draws newer totals would
have sent elsewhere. The law of samples per insert holds for all servers together: a batch is drawn by priorities, and
charged to the servers by what their inserts have earned. The band cannot be narrower than one insert and one batch at
each server, so that K servers have a wider one.

Learning begins when one server has its part of `min_size`: its band lets a batch out, which is drawn from all servers.
That is at about `min_size` transitions, because inserts go to the servers in turn, and earlier while some are away.

A server that is lost is left out until it has come back from its snapshot: learner and actors go on with the others.
Each server is a role of its own: `replay-0`, `replay-1`, with its snapshot, metrics and log. A serial run has one
server. On a cluster each has a place of its own ([cluster](cluster.md)).

When more than one pays: when a server's core is busy, which by the figures above takes some dozens of actors that
nobody holds back; or when the replay is larger than the memory of one host. Draws from several servers cost more than
from one: every batch is a request to each.
"""


if __name__ == "__main__":
    print(document(json.loads(FILE.read_text(encoding="utf-8"))), end="")
