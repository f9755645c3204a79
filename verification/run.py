"""Compute all cases of the verification and write docs/verification.md.

python verification/run.py
python verification/run.py --only punch wavy --output /tmp/page.md

The exit code is 1 if a quantity misses its reference or a case fails.
"""

import sys

from verification.report import main

if __name__ == "__main__":
    sys.exit(main())
