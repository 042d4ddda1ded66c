"""Each setting of replay, learner, exploration, actor and network is changed, and something measurable changes.

The tables below name every field of these sections; a new field without a case fails the first test.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from apex_bat.agent.d3qn import D3QN
from apex_bat.agent.exploration import annealed, ladder_of_actor
from apex_bat.agent.inference import parameter_shapes
from apex_bat.agent.n_step import Accumulator
from apex_bat.agent.network import DuelingNetwork
from apex_bat.config import Config, load, settings
from apex_bat.experience import Batch, Chunk, States
from apex_bat.replay.server import ReplayServer
from apex_bat.replay.store import ReplayStore
from apex_bat.replay.writer import ReplayWriter
from apex_bat.roles.actor import Actor
from apex_bat.roles.checkpoint import Checkpoint
from apex_bat.roles.learner import Learner
from apex_bat.roles.plan import Role
from apex_bat.roles.reporting import RoleReporter
from tests.roles.fakes import Batches, FakeReplay, FakeWeights, assignment

BASE = (
    "network.channels=[4]", "network.strides=[3]", "network.hidden=[8]", "learner.batch_size=16", "bats_per_actor=4",
    "replay.capacity=400", "replay.min_size=100", "actor.chunk_transitions=10", "sonar.rendering=exact",
)  # fmt: skip
Measure = Callable[[Config, Path], object]


def batch_of(size: int) -> Batch:
    generator = np.random.default_rng(0)
    states = States(generator.random((size, 6, 24), np.float32), generator.integers(0, 3, (size, 3)).astype(np.uint8))
    actions = generator.integers(0, 3, size).astype(np.uint8)
    numbers = generator.random((3, size), np.float32)
    return Batch(np.arange(size), numbers[0], states, actions, 9.0 * numbers[1], 0.9 * numbers[2], states)


def learned(config: Config, _: Path) -> float:
    """Updates a network a few times."""
    torch.manual_seed(0)
    agent = D3QN(config, torch.device("cpu"))
    for _round in range(3):
        agent.update(batch_of(16))
    return float(sum(np.abs(array).astype(np.float64).sum() for array in agent.weights().values()))


def averaged(config: Config, _: Path) -> bool:
    """Whether what is handed out after some updates is another network than the online one."""
    torch.manual_seed(0)
    agent = D3QN(config, torch.device("cpu"))
    for _round in range(20):
        agent.update(batch_of(16))
    handed_out = Checkpoint(20, {}, {}, agent.arrays()).policy_parameters()
    return any(not np.array_equal(array, handed_out[name]) for name, array in agent.weights().items())


def computed(config: Config, _: Path) -> object:
    """What an untrained network says of some states, in training."""
    torch.manual_seed(0)
    network = DuelingNetwork(config.network, 3)
    states = batch_of(2).states
    values = network(torch.from_numpy(states.echoes), torch.from_numpy(states.actions))
    return values.q.detach().numpy().round(6).tolist(), sorted(parameter_shapes(config.network, 3))


def chunked(config: Config, _: Path) -> object:
    """The first chunk of a flight of 40 steps."""
    accumulator = Accumulator(config.learner.num_step, config.learner.discount, 3, config.actor.chunk_transitions)
    frame = np.zeros((2, 24), np.float32)
    for step in range(40):
        accumulator.step(frame, 0, float(step), 0.0, 0.0)
        chunk = accumulator.full_chunk(frame)
        if chunk is not None:
            return [array.tolist() for array in chunk[3:]]
    return None


def explored(config: Config, _: Path) -> object:
    """Epsilons of the ladder, of a single bat, and on the way down."""
    part = config.exploration
    annealing = [annealed(steps, part) for steps in (0, 10, 10_000_000)]
    return ladder_of_actor(0, 2, 4, part).tolist(), ladder_of_actor(0, 1, 1, part).tolist(), annealing


def flown(config: Config, folder: Path) -> object:
    """Flies 60 steps: the actions taken, and how often weights were asked for."""
    whole = assignment(config, folder, Role("actor", 0))
    replay, weights, reporter = FakeReplay(), FakeWeights(config), RoleReporter(whole)
    actor = Actor(whole, replay, weights, reporter)
    while actor.is_ready(0.0) and len(replay.chunks) < 8:
        actor.step()
    actor.close()
    reporter.close()
    return weights.num_asked, [chunk.actions.tolist() for chunk in replay.chunks]


def broadcast(config: Config, folder: Path) -> int:
    """Broadcasts of weights within 30 updates."""
    whole = assignment(config, folder, Role("learner", 0))
    weights, reporter = FakeWeights(config), RoleReporter(whole)
    learner = Learner(whole, D3QN(config, torch.device("cpu")), 0, Batches(0), weights, reporter)
    for _ in range(30):
        learner.step(0.0)
    reporter.close()
    return weights.num_published


def requested(config: Config, folder: Path) -> object:
    """What a real server sees of a real learner: requests that wait, and the size of the first batch."""
    from apex_bat.roles.learner import run_learner

    folder.chmod(0o700)
    whole = assignment(config, folder, Role("learner", 0))
    (folder / "checkpoints").mkdir(exist_ok=True)
    server = ReplayServer(config, whole.addresses.replay, np.random.default_rng(0))
    thread = threading.Thread(target=run_learner, args=(whole,))
    thread.start()
    try:
        rounds_left = 100
        while rounds_left:  # some more after the first request, in which no further ones may come
            server.serve(0.1)
            rounds_left = min(rounds_left - 1, 5 if server.metrics()["replay.queued_requests"] else 100)
        waiting = server._outlet.requests.peek()
        return server.metrics()["replay.queued_requests"], getattr(waiting, "batch_size", None)
    finally:
        whole.stop.set()
        thread.join(20)
        server.close()


def filled(config: Config, priorities: Sequence[float] = (0.0, 0.5, 2.0, 100.0)) -> ReplayStore:
    store = ReplayStore(config, np.random.default_rng(0))
    for number, priority in enumerate(priorities):
        accumulator = Accumulator(3, 0.9, 3, 60)
        for _ in range(60):
            accumulator.step(np.zeros((2, 24), np.float32), 0, 0.0, priority, 0.0)
        chunk = accumulator.end(np.zeros((2, 24), np.float32), terminated=True)
        assert chunk is not None
        store.add(f"actor-{number}", 0, [chunk])
    return store


def sampled(config: Config, _: Path) -> object:
    """Shares of four groups of priorities and the weights, at the start and later."""
    store = filled(config)
    drawn = [store.sample(200, step) for step in (0, 30_000)]
    shares = [np.bincount(batch.items // 60, minlength=4).tolist() for batch in drawn]
    return shares, [batch.weights.round(4).tolist() for batch in drawn]


def limited(config: Config, _: Path) -> object:
    """How much is let in before anything was sampled, and out before anything more comes; and what is held."""
    store = ReplayStore(config, np.random.default_rng(0))
    while store.can_add(10) and store.limiter.inserted < 2000:
        store.limiter.count_insert(10)
    inserted = store.limiter.inserted
    store.buffer.add(filled_chunks(), np.ones(60, np.float32), 0, 0)
    while store.can_sample(16) and store.limiter.sampled < 30_000:
        store.limiter.count_sample(16)
    return inserted, store.limiter.sampled, store.buffer.capacity


def filled_chunks() -> list[Chunk]:
    accumulator = Accumulator(3, 0.9, 3, 60)
    for _ in range(60):
        accumulator.step(np.zeros((2, 24), np.float32), 0, 0.0, 0.0, 0.0)
    chunk = accumulator.end(np.zeros((2, 24), np.float32), terminated=True)
    assert chunk is not None
    return [chunk]


def snapshotted(config: Config, folder: Path) -> int:
    """Snapshots that a server writes within two simulated minutes."""
    folder.chmod(0o700)
    now_s = [0.0]
    server = ReplayServer(
        config, f"ipc://{folder}/replay", np.random.default_rng(0), folder / "snapshot", clock=lambda: now_s[0]
    )
    for _ in range(240):
        now_s[0] += 0.5
        server.serve(0.001)
    written = int(server.metrics()["replay.snapshots"])
    server.close()
    return written


def windowed(config: Config, folder: Path) -> int:
    """Chunks that a writer takes while nobody answers."""
    writer = ReplayWriter(f"ipc://{folder}/nobody", "actor-0", config.actor.window_chunks)
    sent = 0
    while writer.has_room and sent < 200:
        writer.send(filled_chunks(), 0)
        sent += 1
    writer.close()
    return sent


CASES: dict[str, tuple[Measure, str]] = {
    "network.channels": (computed, "[5]"),
    "network.strides": (computed, "[2]"),
    "network.hidden": (computed, "[9]"),
    "network.dueling": (computed, "max"),
    "network.input_scale": (computed, "1.0"),
    "network.dropout": (computed, "0.5"),
    "learner.batch_size": (requested, "8"),
    "learner.optimiser": (learned, "adam"),
    "learner.learning_rate": (learned, "0.01"),
    "learner.rmsprop_decay": (learned, "0.5"),
    "learner.rmsprop_centred": (learned, "true"),
    "learner.epsilon": (learned, "0.1"),
    "learner.weight_decay": (learned, "0.1"),
    "learner.loss": (learned, "huber"),
    "learner.gradient_clip": (learned, "0.001"),
    "learner.discount": (chunked, "0.5"),
    "learner.num_step": (chunked, "1"),
    "learner.target_period": (learned, "1"),
    "learner.target_tau": (learned, "0.5"),
    "learner.averaged_updates": (averaged, "0"),
    "learner.weights_period": (broadcast, "3"),
    "learner.precision": (learned, "bfloat16"),
    "learner.prefetch": (requested, "2"),
    "learner.mirror": (learned, "false"),
    "exploration.kind": (flown, "anneal"),
    "exploration.base": (explored, "0.2"),
    "exploration.alpha": (explored, "3.0"),
    "exploration.single": (explored, "0.3"),
    "exploration.anneal_start": (explored, "0.9"),
    "exploration.anneal_end": (explored, "0.1"),
    "exploration.anneal_steps": (explored, "100"),
    "replay.capacity": (limited, "300"),
    "replay.min_size": (limited, "200"),
    "replay.samples_per_insert": (limited, "4.0"),
    "replay.error_buffer": (limited, "900.0"),
    "replay.never_block": (limited, "true"),
    "replay.alpha": (sampled, "0.1"),
    "replay.alpha_end": (sampled, "0.0"),
    "replay.beta": (sampled, "0.9"),
    "replay.beta_end": (sampled, "0.4"),
    "replay.anneal_updates": (sampled, "5_000"),
    "replay.priority_epsilon": (sampled, "1.0"),
    "replay.max_priority": (sampled, "1.0"),
    "replay.snapshot_period_s": (snapshotted, "10.0"),
    "replay.shards": (limited, "2"),
    "actor.chunk_transitions": (chunked, "5"),
    "actor.window_chunks": (windowed, "7"),
    "actor.weights_period": (flown, "2"),
}
ALSO = {"learner.target_tau": ["learner.target_period=0"], "replay.alpha_end": []}
ELSEWHERE = {"learner.compile": "tests/agent/test_d3qn.py: it may change speed only"}
SECTIONS = ("network", "learner", "exploration", "replay", "actor")


def test_every_setting_of_these_sections_has_a_case() -> None:
    kinds = {name: type(getattr(Config(), name)) for name in SECTIONS}
    fields = {f"{section}.{field}" for section, kind in kinds.items() for field in kind.__struct_fields__}
    assert fields == CASES.keys() | ELSEWHERE.keys()
    assert issubclass(kinds["replay"], settings.Replay)


@pytest.mark.parametrize("name", CASES)
def test_the_setting_changes_something(name: str, tmp_path: Path) -> None:
    measure, value = CASES[name]
    base = [*BASE, *ALSO.get(name, [])]
    outcomes: list[Any] = []
    for number, extra in enumerate(([], [f"{name}={value}"])):
        folder = tmp_path / str(number)
        folder.mkdir()
        config = load(None, [*base, *extra])
        assert number == 0 or msgspec.to_builtins(config) != msgspec.to_builtins(load(None, base))
        outcomes.append(measure(config, folder))
    assert outcomes[0] != outcomes[1]
