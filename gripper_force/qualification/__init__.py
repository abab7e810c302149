"""Measurements of the product: benchmarks, numerics, loop margins, faults, fuzzing, soak, paper tables."""
