"""The words of docs/results/peers.md that are no figures: rules, settings, causes, trials."""

HEAD = """# apex_bat beside other libraries

Made by `python -m benchmarks.peers` from measurements on one machine, none of our own work beside them, one environment
after the other, seeds interleaved: first every entry with seed 0, then every one with seed 1, and so on; interrupted,
the command goes on. The same bat learns to fly through the same arena, simple, in the condition memory, with the same
network, settings and cores.

- *The clock* begins with the command and counts everything: imports, start of workers, training. Policies are written
  every {every_s} s and judged afterwards by one function for all, so judging costs nobody time. apex_bat runs as it
  ships: its own evaluator, recordings and snapshots run beside its training and cost it time and memory.
- *Judged* are the 15 flights of `apex-bat evaluate`: fixed starts, no exploration, 1000 steps. Every policy is judged
  until one completes 14; that one's time is the result. After it one a minute is judged, and the last. Progress is the
  mean net way of its flights along the corridor, of at most some 165 m: a bat that circles on the spot completes
  flights, too, but makes none.
- *The registered environment* is `apex_bat/EchoFlight-v0`, many bats in one world, for everybody. *The obvious
  environment* is the same flight with PyBullet's rays and a 125 kHz chain in numpy and scipy, as one would write it at
  first; the peers fly it in processes of their own, 8 bats. apex_bat has no such form: its figures stand beside.
- Figures are medians over seeds, least and greatest in brackets. Steps and updates a second are from the first update
  on. Memory is the greatest sum over all processes, shared pages counted once."""

SETTINGS = """## Settings

The same for all, from `configs/memory.toml` and the defaults: two convolutions of 16 and 32 channels and dueling
streams of 128 units (Stable-Baselines3, without dueling: one stream of 256, as many parameters), inputs scaled by 4,
batches of {learner[batch_size]}, discount {learner[discount]:g}, n = {learner[num_step]}, replay of
{replay[capacity]:,}, first update after {replay[min_size]:,} steps, {replay[samples_per_insert]:g} samples per insert
(one update for {steps:g} steps), target copied every {learner[target_period]} updates, priorities with exponent
{replay[alpha]:g} and importance weights from {replay[beta]:g}, RMSprop with {learner[learning_rate]:g}, gradients
clipped at {learner[gradient_clip]:g}.

What differs, because a library has it so:

| | differs |
|---|---|
| apex_bat | 16 bats in one process (`actors = "auto"` on two cores), each with an epsilon of its own (Ape-X) |
| apex_bat | half of each batch is mirrored |
| apex_bat | judged is the average of its network over 1,500 updates, at first over a tenth of those so far |
| all peers | one epsilon for all bats, from 1.0 to 0.05 over 20,000 steps; 16 bats |
| Tianshou | new transitions get the greatest priority so far |
| Stable-Baselines3 | uniform replay, no double Q-learning, Huber loss; one draw decides whether all bats explore |
| RLlib | importance weights stay at 0.4; new transitions get the greatest priority so far |
| RLlib | 7 to 8 samples per insert: a round of sampling is longer where episodes end |
"""

CAUSES = """## Where the time goes

**Registered.** On two cores an update is the limit of apex_bat and of Stable-Baselines3, and they make about as many a
second, with as many steps. apex_bat's learner fills one core with them; actor, replay server, evaluator and launcher
need about half of the other. What it gains is that it needs fewer than half of Stable-Baselines3's updates. Half of
each batch mirrored and the average of the network are the larger part of it: without both (apex_bat, bare, below) it
took 20, 30 and 35 s, after 1,025 to 1,802 updates. Priorities and an epsilon for each bat were not taken apart further.
Tianshou and RLlib make less than half as many updates a second with the same network and environment; what they spend
the rest on was not profiled. RLlib's policies come and go: one completes 14, and one a minute later completes few.

So the goal is missed for want of updates. Of apex_bat's 20 s some 6 are over before the first update, with imports and
2,000 steps of flight; a third of the best peer's time would leave it some 400 updates. Tried for an earlier start: what
the first seconds do not need is imported later, which brought the first update from 8.7 to 5.7 s after the command (2 s
of it are torch's own import). Tried for faster updates, each beside what was there on the same machine: torch's
optimiser functions instead of its classes, 0.7 of some 11 ms (kept); gradients by hand instead of by autograd, all
parameters in one tensor for the optimiser, an allocator that keeps its memory: no gain that stood out of the noise.
Tried for fewer updates: [a search](tune.md). It found a learning rate and a period of the target network with which
apex_bat needs less than half the time; but the peers share these settings, and gain as much. With the former ones
(commit dda65f8, two seeds) apex_bat took 45 s, Stable-Baselines3 85, Tianshou 200 and RLlib 211. With these, before the
start was made earlier (commit 6624c61, three seeds, when the machine gave everybody a fifth more updates a second),
apex_bat took 19 s, Stable-Baselines3 35, RLlib 86 and Tianshou 95.

The machine is shared: while the registered environment was flown, others took up to a tenth of its two cores (the time
that the kernel counts as stolen), so rates vary from seed to seed. A policy every 5 s resolves apex_bat's time no finer
than that.

**Obvious.** A step costs the peers four times as much there, and what the found settings gained for learning they
gained, too: Stable-Baselines3 is good after some 1,200 updates, RLlib after fewer than 500. A fifteenth of the best
peer's time is 6 s, which is when apex_bat makes its first update: the goal would take a peer that needs five minutes.
"""

TRIALS = """Short trainings with other settings of the peers, one seed each, and of apex_bat without mirror images
and without the average, three seeds; after the contest, on the same machine. One seed says little: as chosen,
Stable-Baselines3 took 30 to 60 s in the two contests of three seeds.
"""
