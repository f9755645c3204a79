"""The script of the README runs unchanged."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.two_ranks


@pytest.mark.mpi
def test_script_runs() -> None:
    """The script ends in equilibrium with 20 N and 5 N to 1e-6."""
    text = (Path(__file__).parent.parent / "README.md").read_text()
    (script,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names: dict = {}
    exec(compile(script, "README.md", "exec"), names)
    resultants = names["contact"].resultants()
    # 10 MPa and 2.5 MPa on 2 mm: equilibrium determines both, independently of friction.
    assert resultants.force == pytest.approx([-5.0, 20.0], rel=1e-6)
    assert resultants.tangential_force >= 5.0 * (1 - 1e-6)
