"""What each process does: actor, replay, learner, evaluator."""
