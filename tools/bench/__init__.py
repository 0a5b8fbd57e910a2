"""Benchmarks: run time against error of every operation, ours and other libraries', in one process."""
