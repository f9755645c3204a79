"""What the README shows runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.two_ranks


@pytest.mark.mpi
def test_script_runs() -> None:
    """The script of the README: it sticks, then slides when the pull nears μ times the force."""
    text = (Path(__file__).parent.parent / "README.md").read_text()
    (script,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    names: dict = {}
    exec(compile(script, "README.md", "exec"), names)
    resultants = names["contact"].resultants()
    # 10 MPa and 2.5 MPa on 2 mm: equilibrium fixes both resultants whatever the friction does.
    assert resultants.force == pytest.approx([-5.0, 20.0], rel=1e-6)
    assert resultants.tangential_force >= 5.0 * (1 - 1e-6)
