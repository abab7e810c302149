"""Benchmarks. Each one alternates with its comparison, so that their ratio holds on a noisy machine."""
