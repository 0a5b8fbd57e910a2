"""Benchmarks: run time against error, our operations and other libraries' in one process."""
