"""Benchmarks of the parts: each module measures one and returns records of figures."""
