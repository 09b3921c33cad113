"""The notebooks run, and do what they say."""

import runpy
from pathlib import Path

from ldrl.towns import Town

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


def test_swap_a_part(monkeypatch, towns):
    monkeypatch.setattr(Town, "load", lambda name: towns[name])  # compiled once
    done = runpy.run_path(str(NOTEBOOKS / "swap_a_part.py"))
    assert done["rollout"].shape == (2, 5)
    assert all(parameter.isfinite().all() for parameter in done["agent"].parameters())
    assert any(parameter is done["attention"].word.weight for parameter in done["agent"].parameters())
    assert sum(done["losses"][-5:]) < sum(done["losses"][:5])
