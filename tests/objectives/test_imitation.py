"""The imitation losses against plain computations, and where their gradients go."""

import math

import pytest
import torch
from tensordict import TensorDict

from ldrl import keys
from ldrl.language import KEYWORDS, Tokenizer
from ldrl.modules import NO_SUBTASK, AgentConfig, HierarchicalAgent, SingleAgent
from ldrl.objectives import ControlLoss, EndOfSubtaskLoss, KeywordLoss, SinglePolicyLoss, SubtaskLoss

SIZES = {"conv_channels": (2, 3, 4), "features": 8, "low_level_hidden": 6, "instruction_hidden": 6}
SIZES |= {"subtask_embedding": 3, "high_level_hidden": 7}
SENTENCES = ("turn left", "take the second right", "straight", "left and then straight please")


@pytest.fixture
def agent():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return HierarchicalAgent(AgentConfig(**SIZES)).eval()


@pytest.fixture(params=["single", "single-history"])
def single(request):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return SingleAgent(AgentConfig(model=request.param, **SIZES)).eval()


@pytest.fixture
def images():
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (4, 5, 1, 88, 200), dtype=torch.uint8, generator=generator)


@pytest.fixture
def slices(images):
    """Four slices of five frames, one of each sub-task."""
    generator = torch.Generator().manual_seed(1)
    td = TensorDict(batch_size=[4, 5])
    td[keys.IMAGE] = images
    td[keys.SUBTASK] = torch.arange(4).unsqueeze(-1).expand(4, 5).clone()
    td[keys.ACTION] = torch.rand(4, 5, 2, generator=generator)
    td[keys.END_OF_SUBTASK] = torch.rand(4, 5, generator=generator) < 0.5
    return td


@pytest.fixture
def decisions(images):
    """Four sequences of at most five decisions: 5, 3, 1 and 2 of them."""
    td = TensorDict(batch_size=[4, 5])
    td[keys.IMAGE] = images
    td[keys.INSTRUCTION_TOKENS] = Tokenizer()(SENTENCES).unsqueeze(1).expand(4, 5, -1).clone()
    td[keys.SUBTASK] = torch.tensor([[3, 0, 3, 1, 4], [3, 2, 4, 4, 4], [4] * 5, [0, 4, 4, 4, 4]])
    td[keys.PREVIOUS_SUBTASK] = torch.cat((torch.full((4, 1), NO_SUBTASK), td[keys.SUBTASK][:, :-1]), 1)
    td["mask"] = torch.arange(5) < torch.tensor([[5], [3], [1], [2]])
    return td


@pytest.fixture
def drives(slices, decisions):
    """Four drives of at most five frames: 5, 3, 1 and 2 of them."""
    return slices.select(keys.IMAGE, keys.ACTION).update(decisions.select(keys.INSTRUCTION_TOKENS, "mask"))


def outputs(policy, data, key):
    """What a low-level policy says to each frame, one step after another from a zero state."""
    rows = []
    for row in range(len(data)):
        state, steps = torch.zeros(1, policy.hidden), []
        for step in range(data.shape[1]):
            td = data[row : row + 1, step].select(keys.IMAGE)
            td[keys.AGENT_SUBTASK] = data[row : row + 1, step][keys.SUBTASK]
            td[policy.state_key] = state
            policy(td)
            state = td["next", *policy.state_key]
            steps.append(td[key][0].tolist())
        rows.append(steps)
    return rows


def test_control_by_hand(agent, slices):
    said = outputs(agent.control, slices, keys.ACTION)
    target = slices[keys.ACTION].tolist()
    gaps = [abs(said[i][j][k] - target[i][j][k]) for i in range(4) for j in range(5) for k in range(2)]
    assert ControlLoss(agent.control)(slices)["loss_control"].item() == pytest.approx(sum(gaps) / len(gaps), abs=1e-6)


def test_end_of_subtask_by_hand(agent, slices):
    said = outputs(agent.end_of_subtask, slices, keys.END_LOGIT)
    ended = slices[keys.END_OF_SUBTASK].tolist()
    share = [1 / (1 + math.exp(-said[i][j][0])) for i in range(4) for j in range(5)]
    truth = [ended[i][j] for i in range(4) for j in range(5)]
    losses = [-math.log(p if end else 1 - p) for p, end in zip(share, truth, strict=True)]
    right = [(p > 0.5) == end for p, end in zip(share, truth, strict=True)]
    out = EndOfSubtaskLoss(agent.end_of_subtask)(slices)
    assert out["loss_end_of_subtask"].item() == pytest.approx(sum(losses) / 20, abs=1e-6)
    assert out["accuracy_end_of_subtask"].item() == pytest.approx(sum(right) / 20)


def test_subtask_by_hand(agent, decisions):
    losses, right = [], []
    for row, length in enumerate((5, 3, 1, 2)):
        state = torch.zeros(1, agent.high_level.hidden)
        for step in range(length):
            td = decisions[row : row + 1, step].select(keys.IMAGE, keys.INSTRUCTION_TOKENS, keys.PREVIOUS_SUBTASK)
            td[keys.HIGH_LEVEL_STATE] = state
            agent.high_level(td)
            state = td["next", *keys.HIGH_LEVEL_STATE]
            logits, target = td[keys.SUBTASK_LOGITS][0].tolist(), int(decisions[keys.SUBTASK][row, step])
            losses.append(math.log(sum(math.exp(v) for v in logits)) - logits[target])
            right.append(logits.index(max(logits)) == target)
    out = SubtaskLoss(agent.high_level)(decisions)
    assert out["loss_subtask"].item() == pytest.approx(sum(losses) / 11, abs=1e-6)
    assert out["accuracy_subtask"].item() == pytest.approx(sum(right) / 11)


@pytest.mark.parametrize("part", ["control", "end_of_subtask", "high_level"])
def test_gradients_reach_the_trained_network_and_no_other(agent, slices, decisions, part):
    losses = {"control": ControlLoss, "end_of_subtask": EndOfSubtaskLoss, "high_level": SubtaskLoss}
    loss = losses[part](getattr(agent, part))
    total = sum(v for k, v in loss(decisions if part == "high_level" else slices).items() if k.startswith("loss_"))
    total.backward()
    trained = dict(getattr(agent, part).named_parameters())
    assert {id(p) for p in loss.parameters()} == {id(p) for p in trained.values()}
    for name, parameter in trained.items():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
        assert parameter.grad.isfinite().all(), name
    for name, parameter in agent.named_parameters():
        assert name.startswith(part) or parameter.grad is None, name


def test_training_moves_the_agent(agent, slices):
    loss = ControlLoss(agent.control)
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    values = []
    for _ in range(8):
        value = loss(slices)["loss_control"]
        value.backward()
        optimizer.step()
        optimizer.zero_grad()
        values.append(float(value.detach()))
    said = torch.tensor(outputs(agent.control, slices, keys.ACTION))
    assert values[-1] < values[0]
    assert float((said - slices[keys.ACTION]).abs().mean()) < values[0]


@pytest.mark.parametrize("garbage", [0, 1, 255])
def test_padding_counts_for_nothing(agent, decisions, garbage):
    loss = SubtaskLoss(agent.high_level)
    expected = loss(decisions)
    expected["loss_subtask"].backward()
    before = [p.grad.clone() for p in loss.parameters()]
    padding = ~decisions["mask"]
    decisions[keys.IMAGE][padding] = garbage
    decisions[keys.INSTRUCTION_TOKENS][padding] = garbage
    decisions[keys.PREVIOUS_SUBTASK][padding] = 10**6
    decisions[keys.SUBTASK][padding] = -(10**6)
    loss.zero_grad()
    found = loss(decisions)
    found["loss_subtask"].backward()
    for key in expected.keys():  # noqa: SIM118
        assert torch.equal(found[key], expected[key])
    for parameter, gradient in zip(loss.parameters(), before, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_nothing_but_padding_is_zero(agent, decisions):
    decisions["mask"] = torch.zeros(4, 5, dtype=torch.bool)
    out = SubtaskLoss(agent.high_level)(decisions)
    assert out["loss_subtask"] == 0
    assert out["accuracy_subtask"] == 0


def features(module):
    """Collects what ``module`` of a loss's policy puts out, and keeps its gradients."""
    found = []

    def keep(_, __, out):
        out.retain_grad()
        found.append(out)

    module.register_forward_hook(keep)
    return found


def test_control_learns_through_time(agent, slices):
    loss = ControlLoss(agent.control)
    found = features(loss.policy.module[1].module)
    gradients = []
    for target in (-9.0, 9.0):
        slices[keys.ACTION][:, -1] = target
        loss(slices)["loss_control"].backward()
        gradients.append(found[-1].grad.view(4, 5, -1)[:, 0])
    # What is right at the last frame changes what the features of the first should have been.
    assert ((gradients[0] - gradients[1]).abs().amax(-1) > 1e-7).all()


def test_end_of_subtask_learns_through_time(agent, slices):
    loss = EndOfSubtaskLoss(agent.end_of_subtask)
    found = features(loss.policy.module[1].module)
    gradients = []
    for _ in range(2):
        loss(slices)["loss_end_of_subtask"].backward()
        gradients.append(found[-1].grad.view(4, 5, -1)[:, 0])
        slices[keys.END_OF_SUBTASK][:, -1] ^= True
    assert ((gradients[0] - gradients[1]).abs().amax(-1) > 1e-7).all()


def test_subtask_learns_through_time(agent, decisions):
    loss = SubtaskLoss(agent.high_level)
    found = features(loss.policy.module[-1].module.linear)
    gradients = []
    for last in (3, 1):
        decisions[keys.SUBTASK][0, 4] = last
        first = len(found)
        loss(decisions)["loss_subtask"].backward()
        gradients.append(found[first].grad)
    changed = (gradients[0] - gradients[1]).abs().amax(-1) > 1e-8
    assert changed.tolist() == [True, False, False, False]


def test_keyword_loss_is_the_plain_computation(agent):
    tokens = Tokenizer()(SENTENCES)
    keyword = torch.tensor([0, 13, 2, len(KEYWORDS)])
    data = TensorDict({keys.INSTRUCTION_TOKENS: tokens, keys.KEYWORD: keyword}, [4])
    loss = KeywordLoss(agent.high_level)
    found = loss(data.unsqueeze(-1))
    states, is_word = agent.high_level[0].module(tokens)
    said = agent.high_level[1].module(states, is_word, torch.zeros(4, 7))
    logits = loss.head(said)
    plain = [-logits[k].log_softmax(-1)[keyword[k]] for k in range(4)]
    torch.testing.assert_close(found["loss_keyword"], sum(plain) / 4)
    right = sum(int(logits[k].argmax() == keyword[k]) for k in range(4))
    assert found["accuracy_keyword"] == right / 4


def test_keyword_loss_trains_what_reads(agent):
    before = {name: value.clone() for name, value in agent.high_level.reader.named_parameters()}
    loss = KeywordLoss(agent.high_level)
    data = TensorDict({keys.INSTRUCTION_TOKENS: Tokenizer()(SENTENCES), keys.KEYWORD: torch.arange(4)}, [4])
    optimizer = torch.optim.Adam(loss.parameters(), 0.02)
    losses = []
    for _ in range(40):
        losses.append(loss(data)["loss_keyword"])
        losses[-1].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert losses[-1] < 0.3 * losses[0]
    assert loss(data)["accuracy_keyword"] == 1
    # The agent's own parameters are trained; but what asks for words, and the query of a zero state is zero.
    trained = {
        name for name, value in agent.high_level.reader.named_parameters() if not torch.equal(value, before[name])
    }
    assert trained == before.keys() - {"module.1.module.score.weight"}


def test_single_policy_loss_is_the_plain_computation(single, drives):
    gaps = []
    for row, length in enumerate((5, 3, 1, 2)):
        state, before = torch.zeros(1, 7), torch.zeros(1, 2)
        for step in range(length):
            td = drives[row, step].unsqueeze(0).select(keys.IMAGE, keys.INSTRUCTION_TOKENS)
            td[keys.HIGH_LEVEL_STATE], td[keys.PREVIOUS_ACTION] = state, before
            single.policy(td)
            state, before = td["next", *keys.HIGH_LEVEL_STATE], drives[keys.ACTION][row, step : step + 1]
            gaps += (td[keys.ACTION] - before).abs().flatten().tolist()
    found = SinglePolicyLoss(single.policy)(drives)["loss_action"]
    assert float(found.detach()) == pytest.approx(sum(gaps) / len(gaps), rel=1e-5)


def test_padding_of_drives_counts_for_nothing(single, drives):
    loss = SinglePolicyLoss(single.policy)
    expected = loss(drives)["loss_action"]
    padding = ~drives["mask"]
    drives[keys.IMAGE][padding] = 255
    drives[keys.ACTION][padding] = 1e9
    assert torch.equal(loss(drives)["loss_action"], expected)
    drives["mask"] = torch.zeros_like(padding)
    assert loss(drives)["loss_action"] == 0


def test_losses_say_what_they_read_and_write(agent, single, slices, decisions, drives):
    words = TensorDict({keys.INSTRUCTION_TOKENS: Tokenizer()(SENTENCES), keys.KEYWORD: torch.arange(4)}, [4])
    for loss, data in (
        (ControlLoss(agent.control), slices),
        (EndOfSubtaskLoss(agent.end_of_subtask), slices),
        (KeywordLoss(agent.high_level), words),
        (SubtaskLoss(agent.high_level), decisions),
        (SinglePolicyLoss(single.policy), drives),
    ):
        assert set(loss(data.select(*loss.in_keys)).keys()) == set(loss.out_keys)
        for key in loss.in_keys:
            with pytest.raises(KeyError):
                loss(data.exclude(key))
        name, key = next(iter(vars(loss.tensor_keys).items()))
        loss.set_keys(**{name: "mine"})
        assert "mine" in loss.in_keys
        assert key not in loss.in_keys


@pytest.mark.parametrize(
    ("loss", "part", "renamed"),
    [
        (ControlLoss, "control", {"action": keys.ACTION, "subtask": keys.SUBTASK}),
        (EndOfSubtaskLoss, "end_of_subtask", {"end_of_subtask": keys.END_OF_SUBTASK, "subtask": keys.SUBTASK}),
        (SubtaskLoss, "high_level", {"subtask": keys.SUBTASK, "mask": "mask"}),
    ],
)
def test_keys_can_be_set(agent, slices, decisions, loss, part, renamed):
    module = loss(getattr(agent, part))
    data = decisions if loss is SubtaskLoss else slices
    expected = module(data)
    for name, key in renamed.items():
        data.rename_key_(key, ("mine", name))
    module.set_keys(**{name: ("mine", name) for name in renamed})
    found = module(data)
    for key in expected.keys():  # noqa: SIM118
        assert torch.equal(found[key], expected[key])


def test_data_is_not_changed(agent, slices, decisions):
    for loss, data in (
        (ControlLoss(agent.control), slices),
        (EndOfSubtaskLoss(agent.end_of_subtask), slices),
        (SubtaskLoss(agent.high_level), decisions),
    ):
        before = data.clone()
        loss(data)
        assert set(data.keys(True, True)) == set(before.keys(True, True))
        assert (data == before).all()
