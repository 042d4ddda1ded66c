"""apex_bat: distributed actor-learner training of an artificial bat that flies by its echoes."""

__version__ = "0.1.0"
