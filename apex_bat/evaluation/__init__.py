"""Judging policies: flights, baselines, statistics, figures."""
