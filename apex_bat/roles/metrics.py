"""Every figure that roles report: name, unit, meaning. `docs/metrics.md` is made from here, and a test holds it to it.

Run `python -m apex_bat.roles.metrics > docs/metrics.md` after a change.
"""

from __future__ import annotations

from apex_bat.replay.metrics import METRICS, READER_METRICS, WRITER_METRICS, Metric
from apex_bat.transport.refusals import PUBLISHER_REASONS, REASONS

PROCESS_METRICS: dict[str, Metric] = {
    "process.memory_mb": Metric("MB", "resident memory of the process, of 1e6 bytes"),
    "process.open_files": Metric("files", "open in the process: files, sockets and pipes"),
}

ACTOR_METRICS: dict[str, Metric] = {
    "env_steps": Metric("steps", "flown by all bats of this process"),
    "env_steps_per_s": Metric("steps/s", "the same, since the last row"),
    "episodes": Metric("episodes", "ended"),
    "episodes_per_s": Metric("episodes/s", "the same, since the last row"),
    "return": Metric("1", "mean undiscounted return of the episodes that ended since the last row"),
    "return_count": Metric("episodes", "that `return` is the mean of"),
    "return_greedy": Metric("1", "the same over the bats whose epsilon is below 0.01"),
    "return_greedy_count": Metric("episodes", "that `return_greedy` is the mean of"),
    "learner_step": Metric("updates", "that the weights in use had seen"),
    "waits": Metric("times", "that the actor could not go on for want of weights or of room in its window"),
    "waits_per_s": Metric("times/s", "the same, since the last row"),
    "share.simulation": Metric("1", "share of the time spent in the environment"),
    "share.policy": Metric("1", "share of the time spent in the network"),
    "share.gathering": Metric("1", "share of the time spent on chunks and sending them"),
    **WRITER_METRICS,
    **PROCESS_METRICS,
}

LEARNER_METRICS: dict[str, Metric] = {
    "updates": Metric("updates", "made by this process"),
    "updates_per_s": Metric("updates/s", "the same, since the last row"),
    "learner_step": Metric("updates", "made in the whole run"),
    "weights_version": Metric("versions", "broadcast"),
    "loss": Metric("1", "mean weighted loss since the last row"),
    "loss_count": Metric("updates", "that `loss` is the mean of"),
    "gradient_norm": Metric("1", "mean global norm of the gradient before clipping"),
    "gradient_norm_count": Metric("updates", "that `gradient_norm` is the mean of"),
    "q_mean": Metric("1", "mean value of the sampled actions"),
    "q_mean_count": Metric("updates", "that `q_mean` is the mean of"),
    "weights_norm.filters": Metric("1", "Euclidean norm of the parameters of all convolutions"),
    "weights_norm.value": Metric("1", "the same of the value stream"),
    "weights_norm.advantage": Metric("1", "the same of the advantage stream"),
    "share.waiting": Metric("1", "share of the time without a batch: the learner's idle share"),
    "share.update": Metric("1", "share of the time spent on updates"),
    "share.weights": Metric("1", "share of the time spent on broadcasts"),
    "share.checkpoint": Metric("1", "share of the time spent on checkpoints"),
    "weights.subscribers": Metric("subscribers", "actors that asked for weights within the last 10 s"),
    **{f"weights.refused.{reason}": Metric("messages", REASONS[reason]) for reason in PUBLISHER_REASONS},
    **READER_METRICS,
    **PROCESS_METRICS,
}

EVALUATOR_METRICS: dict[str, Metric] = {
    "evaluations": Metric("evaluations", "made by this process"),
    "evaluations_per_s": Metric("evaluations/s", "the same, since the last row"),
    "learner_step": Metric("updates", "of the checkpoint judged last"),
    "completed_share": Metric("1", "share of its flights that reached the time limit"),
    "progress_m": Metric("m", "mean net way along the corridor"),
    "steps": Metric("steps", "mean length of a flight"),
    "return": Metric("1", "mean undiscounted return"),
    **PROCESS_METRICS,
}

DECLARED: dict[str, dict[str, Metric]] = {
    "actor": ACTOR_METRICS,
    "learner": LEARNER_METRICS,
    "replay": METRICS | PROCESS_METRICS,
    "evaluator": EVALUATOR_METRICS,
}


def document() -> str:
    """Returns all declarations as a page of Markdown."""
    lines = ["# Metrics", "", "Rows of `metrics/ROLE.jsonl` and TensorBoard scalars. Made by `python -m "
             "apex_bat.roles.metrics`.", "", "Each row also carries `unix_s`, `elapsed_s` (since the first environment "
             "step), `role`, `pid`, `state` (what the role does or waits for), and the run's `env_steps_total` and "
             "`learner_step_total`."]  # fmt: skip
    for role, metrics in DECLARED.items():
        lines += ["", f"## {role}", "", "| name | unit | meaning |", "|---|---|---|"]
        lines += [f"| `{name}` | {metric.unit} | {metric.meaning} |" for name, metric in metrics.items()]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(document(), end="")  # noqa: T201  # a page to redirect into a file
