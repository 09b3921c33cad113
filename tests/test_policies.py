"""What policies may read: the image, the instruction and the agent's own memory, nothing privileged."""

import inspect

import pytest
import torch
from tensordict.nn import TensorDictModuleBase

import ldrl.modules
from ldrl import keys
from ldrl.envs import make_env
from ldrl.modules import MODELS, AgentConfig, SwitchingController, make_agent

LABELS = (keys.SUBTASK, keys.END_OF_SUBTASK)


@pytest.fixture(scope="module", params=MODELS)
def agent(request):
    sizes = {"conv_channels": (2, 3, 4), "features": 8, "low_level_hidden": 6, "high_level_hidden": 7}
    return make_agent(AgentConfig(model=request.param, **sizes)).eval()


def readable(key):
    return key in (keys.IMAGE, keys.INSTRUCTION_TOKENS) or key[0] == keys.AGENT


def readers(agent):
    return [module for module in agent.modules() if isinstance(module, TensorDictModuleBase)]


def test_every_module_is_among_them():
    """A TensorDictModule that ldrl.modules makes public is held to the rule below, too."""
    public = {value for value in vars(ldrl.modules).values() if inspect.isclass(value)}
    public = {value for value in public if issubclass(value, TensorDictModuleBase)}
    found = [module for model in MODELS for module in readers(make_agent(AgentConfig(model=model)))]
    assert all(any(isinstance(module, cls) for module in found) for cls in public)
    assert SwitchingController in public


def test_no_module_reads_the_world_or_the_labels(agent):
    for module in readers(agent):
        assert module.in_keys
        for key in module.in_keys:
            assert readable(key), (type(module).__name__, key)


def test_no_module_writes_the_world_or_the_labels(agent):
    for module in readers(agent):
        for key in module.out_keys:
            written = key[1:] if key[0] == "next" else key
            assert key == keys.ACTION or readable(written), (type(module).__name__, key)


def test_garbage_in_the_world_changes_nothing(agent, town2, episodes):
    def actions(spoil):
        env = make_env(town2, episodes=episodes["town2"][:4], policy=agent)
        td, done = env.reset(), []
        for _ in range(6):
            seen = td.clone()
            if spoil:
                for key in (*seen.select(keys.WORLD).keys(True, True), *LABELS):
                    seen[key] = torch.full_like(seen[key], 1) if seen[key].dtype == torch.bool else seen[key] * 0 + 97
            agent(seen)
            done.append(seen[keys.ACTION])
            td = env.step(td.update(seen.select(*agent.out_keys)))["next"]
        return torch.stack(done)

    assert torch.equal(actions(True), actions(False))


def test_the_world_need_not_be_there(agent, town2):
    td = make_env(town2, 2, policy=agent).reset()
    assert torch.equal(agent(td.select(*agent.in_keys))[keys.ACTION], agent(td)[keys.ACTION])
