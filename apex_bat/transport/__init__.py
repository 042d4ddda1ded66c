"""The wire: typed messages over ZeroMQ, CURVE keys, weights."""
