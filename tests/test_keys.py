"""The keys: one name, one meaning."""

import ast
import inspect
from itertools import pairwise

from torchrl.data.vla import schema

from ldrl import keys

CONSTANTS = {name: value for name, value in vars(keys).items() if name.isupper() and not name.endswith("_KEY")}


def test_all_is_complete_and_sorted():
    assert set(keys.__all__) == set(CONSTANTS)
    assert keys.__all__ == sorted(keys.__all__)


def test_keys_are_unique():
    values = list(CONSTANTS.values())
    assert len(values) == len(set(values)) > 20


def test_keys_are_strings_or_pairs_under_a_known_parent():
    for name, value in CONSTANTS.items():
        if isinstance(value, tuple):
            assert value[0] in (keys.WORLD, keys.AGENT, "observation"), name
            assert all(isinstance(part, str) for part in value), name
        else:
            assert isinstance(value, str), name
            assert value not in ("next", "done", "reward", "_reset"), name


def test_keys_follow_the_schema_of_torchrl():
    assert keys.ACTION == schema.ACTION_KEY
    assert keys.IMAGE == schema.IMAGE_KEY
    assert keys.INSTRUCTION == schema.INSTRUCTION_KEY


def test_every_key_is_documented():
    body = ast.parse(inspect.getsource(keys)).body
    documented = {
        before.targets[0].id
        for before, after in pairwise(body)
        if isinstance(before, ast.Assign) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    }
    assert set(CONSTANTS) - documented <= {"WORLD"}
