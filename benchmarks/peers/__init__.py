"""Other libraries' DQN beside apex_bat: the same bat, network, settings, cores and judging.

Run `python -m benchmarks.peers`.

| module | holds |
|---|---|
| `terms` | what is the same for all, and who takes part |
| `environments` | the registered environment and the obvious one, with flat observations |
| `network` | the network for libraries that train a torch module, and its parameters by apex_bat's names |
| `notebook` | what a training process writes down: steps, updates and policies over its time |
| `training` | the process of one training; it calls `tianshou_peer`, `sb3_peer` or `rllib_peer` |
| `apex_bat_entry` | apex_bat's own training, from the same point of view |
| `process_tree` | CPU seconds and memory of a training with all its children |
| `judging` | how many of 15 flights a policy completes |
| `contest` | runs everything, one after another, and goes on where it was interrupted |
| `report`, `figure` | docs/results/peers.md and its picture |
"""
