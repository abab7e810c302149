"""Benchmarks. Each alternates with what it is compared with, so that ratios are valid on a busy machine."""
