"""Published ratios: one script for each group, which runs its rivals in the same run; `bench.py` runs them all."""
