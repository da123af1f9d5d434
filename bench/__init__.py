"""Benchmarks: every kernel beside its peers, the whole frame, the start; `make bench` runs them all."""
