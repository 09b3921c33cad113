"""Checkpoints: there and back, and every way in which one can be broken."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from ldrl import keys
from ldrl.modules import (
    AgentConfig,
    HierarchicalAgent,
    checkpoint,
    copy_trained,
    load_agent,
    make_agent,
    resolve_checkpoint,
    save_agent,
)

WEIGHTS, CONFIG = "agent.safetensors", "agent.json"


@pytest.fixture
def saved(agent, tmp_path):
    save_agent(agent, tmp_path / "runs" / "one")
    return tmp_path / "runs" / "one"


def test_there_and_back(agent, saved, drive):
    assert sorted(path.name for path in saved.iterdir()) == [CONFIG, WEIGHTS]
    loaded = load_agent(saved)
    assert loaded.config == agent.config
    assert not loaded.training
    first, second = drive(agent, 3, 8), drive(loaded, 3, 8)
    for key in (keys.ACTION, keys.AGENT_SUBTASK):
        assert torch.equal(first[key], second[key])
    assert resolve_checkpoint(str(saved)) == saved
    assert HierarchicalAgent.from_pretrained(str(saved)).config == agent.config


def test_checkpoints_are_small_and_plain(agent, saved):
    weights = load_file(saved / WEIGHTS)
    learned = sum(p.numel() for p in agent.parameters())
    assert sum(value.numel() for value in weights.values()) == learned + 1000  # the usual words
    assert json.loads((saved / CONFIG).read_text())["conv_channels"] == list(agent.config.conv_channels)


def test_half_precision_halves_the_file(agent, saved, tmp_path):
    save_agent(agent, tmp_path / "half", dtype=torch.float16)
    sizes = [(folder / WEIGHTS).stat().st_size for folder in (saved, tmp_path / "half")]
    assert sizes[1] < 0.6 * sizes[0]
    loaded = load_agent(tmp_path / "half").state_dict()
    for name, value in load_agent(saved).state_dict().items():
        assert loaded[name].dtype == value.dtype
        torch.testing.assert_close(loaded[name], value, rtol=1e-3, atol=1e-7)


def test_an_old_checkpoint_is_replaced(agent, saved, tiny):
    other = HierarchicalAgent(tiny)
    save_agent(other, saved)
    assert torch.equal(next(load_agent(saved).parameters()), next(other.parameters()))


def test_a_failed_save_leaves_the_old_one(agent, saved, tiny, monkeypatch):
    def disk_full(weights, path):
        path.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(checkpoint, "save_file", disk_full)
    with pytest.raises(OSError, match="No space left"):
        save_agent(HierarchicalAgent(tiny), saved)
    assert torch.equal(next(load_agent(saved).parameters()), next(agent.parameters()))


def test_the_first_save_that_fails_leaves_no_checkpoint(agent, tmp_path, monkeypatch):
    def disk_full(weights, path):
        path.write_bytes(b"half")
        raise OSError("No space left on device")

    monkeypatch.setattr(checkpoint, "save_file", disk_full)
    with pytest.raises(OSError, match="No space left"):
        save_agent(agent, tmp_path)
    with pytest.raises(ValueError, match="no checkpoint"):
        load_agent(tmp_path)


@pytest.mark.parametrize("name", ["atlantis", "", "..", "no/such/folder"])
def test_unknown_names(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=rf"no checkpoint '{name}'; give a folder with {WEIGHTS} and {CONFIG}, or one"):
        load_agent(name)


@pytest.mark.parametrize("lacking", [WEIGHTS, CONFIG])
def test_half_a_checkpoint_is_none(saved, lacking):
    (saved / lacking).unlink()
    with pytest.raises(ValueError, match="no checkpoint"):
        load_agent(saved)


def test_drives_with_the_weights_of_another(saved, agent):
    borrower = saved.parent / "borrower"
    borrower.mkdir()
    (borrower / CONFIG).write_text(json.dumps({"modality": "ps", "weights": f"../{saved.name}"}))
    loaded = load_agent(borrower)
    assert vars(loaded.config) == vars(agent.config) | {"modality": "ps"}
    assert all(torch.equal(value, agent.state_dict()[name]) for name, value in loaded.state_dict().items())
    (saved / WEIGHTS).unlink()
    with pytest.raises(ValueError, match="no checkpoint"):
        load_agent(borrower)


@pytest.mark.parametrize("keep", [0, 5, 100, -1])
def test_truncated_weights(saved, keep):
    content = (saved / WEIGHTS).read_bytes()
    (saved / WEIGHTS).write_bytes(content[:keep])
    with pytest.raises(ValueError, match=rf"{WEIGHTS} is no complete safetensors file .*; copy or train it anew"):
        load_agent(saved)


def test_weights_of_something_else(saved):
    (saved / WEIGHTS).write_bytes(b"PK\x03\x04" * 100)
    with pytest.raises(ValueError, match="no complete safetensors file"):
        load_agent(saved)
    save_file({"linear.weight": torch.zeros(2, 2)}, saved / WEIGHTS)
    with pytest.raises(ValueError, match=rf"{WEIGHTS} does not fit .*{CONFIG}: .* use the weights and the con"):
        load_agent(saved)


def test_weights_of_other_sizes(saved, tiny):
    other = HierarchicalAgent(AgentConfig(**{**vars(tiny), "low_level_hidden": 9}))
    save_agent(other, saved.parent / "two")
    (saved / WEIGHTS).write_bytes((saved.parent / "two" / WEIGHTS).read_bytes())
    with pytest.raises(ValueError, match=r"does not fit .*: control\..* is \(27.*, expected \(18"):
        load_agent(saved)


@pytest.mark.parametrize("change", [{"missing": True}, {"extra": True}])
def test_one_weight_too_few_or_too_many(saved, change):
    weights = load_file(saved / WEIGHTS)
    name = next(iter(weights))
    if "missing" in change:
        del weights[name]
    else:
        weights["another"] = torch.zeros(1)
    save_file(weights, saved / WEIGHTS)
    with pytest.raises(ValueError, match="is missing, expected" if "missing" in change else r"another is \(1,\), exp"):
        load_agent(saved)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is no agent config"),
        (b'{"features": 8', "is no agent config"),
        (b"\xff\xfe", "is no agent config"),
        (b"[1, 2]", "is no agent config"),
        (b"null", "is no agent config"),
        (b'{"colour": "red"}', "is no agent config .*colour"),
        (b'{"features": "eight"}', "is no agent config .*features is 'eight'; give a whole number above 0"),
        (b'{"features": -8}', "is no agent config .*features is -8; give"),
        (b'{"features": 8.5}', "is no agent config .*features is 8.5; give"),
        (b'{"conv_channels": [4, 4]}', r"is no agent config .*conv_channels is \[4, 4\]; give three sizes"),
        (b'{"conv_channels": 4}', "is no agent config"),
        (b'{"image_rows": 20}', "is no agent config .*rows is 20; an image has 88"),
        (b'{"image_rows": 89}', "is no agent config .*rows is 89; an image has 88"),
    ],
)
def test_broken_configs(saved, content, message):
    (saved / CONFIG).write_bytes(content)
    with pytest.raises(ValueError, match=rf"{CONFIG} {message}.*it is a JSON object with model, modality"):
        load_agent(saved)


def test_levels_are_taken_from_the_checkpoints_named_for_them(tmp_path):
    small = {"conv_channels": (2, 3, 4), "features": 8, "low_level_hidden": 6, "high_level_hidden": 7}
    for name, model, modality in (("gs-h0", "h0", "gs"), ("rgb-hih", "hih", "rgb"), ("ps-hih", "hih", "ps")):
        save_agent(make_agent(AgentConfig(model=model, modality=modality, **small)), tmp_path / name)
    for modality in ("rgb", "ps"):
        low, high = tmp_path / f"{modality}-hih", tmp_path / "gs-h0"
        agent = make_agent(AgentConfig(model="h0", modality=modality, **small))
        copied = copy_trained(agent, low, high)
        assert sorted(copied) == ["control", "end_of_subtask", "high_level"]
        for part, origin in (("control", low), ("end_of_subtask", low), ("high_level", high)):
            theirs = getattr(load_agent(origin), part).state_dict()
            ours = getattr(agent, part).state_dict()
            assert all(ours[key].equal(value) for key, value in theirs.items())


def test_of_a_network_that_does_not_fit_its_fitting_parts_are_taken(tmp_path):
    small = {"conv_channels": (2, 3, 4), "features": 8, "low_level_hidden": 6, "high_level_hidden": 7}
    trained = make_agent(AgentConfig(modality="gs", **small))
    save_agent(trained, tmp_path / "gs-hih")
    agent = make_agent(AgentConfig(model="single", modality="rgb", **small))
    before = {key: value.clone() for key, value in agent.state_dict().items()}
    copied = copy_trained(agent, high_level=str(tmp_path / "gs-hih"))
    assert "policy" not in copied
    theirs = {f"policy.{key}": value for key, value in trained.high_level.state_dict().items()}
    for key, value in agent.state_dict().items():
        taken = any(key.startswith(f"{part}.") for part in copied)
        assert value.equal(theirs[key] if taken else before[key]), key
    assert any(
        key.startswith("policy.module.0.") and value.equal(theirs[key]) for key, value in agent.state_dict().items()
    )
