"""Fuzzing of the package with mutated messages, parameters and files.

A case is given by its part, seed and number. It survives (there is a result), is refused with a
reason, or fails. test_fuzz.py runs a few cases of every part; for long runs, in the folder test:

    ../.venv/bin/python -m fuzz messages --minutes 20 --seed 1
    ../.venv/bin/python -m fuzz files --first 17 --cases 1
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "support"))  # for runs without pytest
