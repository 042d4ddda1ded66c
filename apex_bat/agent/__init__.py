"""The policy: dueling network, losses, exploration."""
