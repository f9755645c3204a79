"""Scripts that measure what contact costs; `run.py` starts them and joins what they find."""
