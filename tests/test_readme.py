"""The README's Python runs as it stands."""

import re
from pathlib import Path

from ldrl.towns import Town

README = Path(__file__).parents[1] / "README.md"


def test_python_blocks_run_one_after_another(monkeypatch, towns, capsys):
    load = Town.load
    monkeypatch.setattr(Town, "load", lambda name: towns[name] if name in towns else load(name))  # compiled once
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) >= 4
    names = {}
    for block in blocks:
        exec(block, names)
    assert names["rollout"].shape == (2, 3)
    assert "(20, 4) (600, 600, 3)" in capsys.readouterr().out
