# %% [markdown]
# # Swap a part for one's own
# Every box of an agent is a module with TensorDict keys. Put another one with the same keys in its place, and
# environments, losses and evaluation go on as before.

# %%
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import Compose

from ldrl.collectors import BoundarySampler, DisturbedView, OncePerFrame, collect_demonstrations
from ldrl.envs import DashCamera, make_env
from ldrl.modules import AgentConfig, make_agent
from ldrl.objectives import SubtaskLoss
from ldrl.towns import Town

torch.manual_seed(0)
town = Town.load("town1")
agent = make_agent(AgentConfig(model="hih"))

# %% [markdown]
# The high-level policy is a chain. What each part reads and writes:

# %%
for k, part in enumerate(agent.high_level.module):
    print(k, type(part.module).__name__, part.in_keys, "->", part.out_keys)


# %% [markdown]
# Part 1 is Luong's attention. In its place, additive attention (Bahdanau et al., 2015): it takes the words' states,
# which of them are words, and the decoder's state, and gives one vector.


# %%
class AdditiveAttention(nn.Module):
    """Scores each word by a small network on its state and the decoder's."""

    def __init__(self, encoder: int, decoder: int, hidden: int = 32) -> None:
        super().__init__()
        self.word = nn.Linear(encoder, hidden)
        self.asked = nn.Linear(decoder, hidden, bias=False)
        self.score = nn.Linear(hidden, 1)

    def forward(self, states: Tensor, is_word: Tensor, decoder: Tensor) -> Tensor:
        """The weighted mean of the states, ``[B, E]``."""
        score = self.score((self.word(states) + self.asked(decoder).unsqueeze(-2)).tanh()).squeeze(-1)
        weights = score.masked_fill(~is_word, -1e9).softmax(-1) * is_word
        return (weights.unsqueeze(-2) @ states).squeeze(-2)


luong = agent.high_level.module[1]
attention = AdditiveAttention(agent.config.instruction_hidden, agent.config.high_level_hidden)
agent.high_level.module[1] = TensorDictModule(attention, luong.in_keys, luong.out_keys)

# %% [markdown]
# It drives (badly, for it is not trained):

# %%
rollout = make_env(town, num_cars=2, policy=agent).rollout(5, agent)
print("sub-tasks", rollout["agent", "subtask"].tolist())

# %% [markdown]
# And it trains, with the loss, the sampler and the camera of the recipe. A few steps show that it learns; the recipe
# takes 1,200 or more.

# %%
demonstrations = collect_demonstrations(town, 38_400)
sampler = BoundarySampler(demonstrations, town)
buffer = TensorDictReplayBuffer(
    storage=demonstrations.storage,
    sampler=sampler,
    batch_size=16 * sampler.decisions,
    transform=Compose(DisturbedView(town, slice_length=1), OncePerFrame(DashCamera(town))),
)
loss = SubtaskLoss(agent.high_level)
optimizer = torch.optim.Adam(loss.parameters(), 2e-3)
losses = []
for _ in range(20):
    value = loss(buffer.sample().reshape(16, -1))["loss_subtask"]
    value.backward()
    optimizer.step()
    optimizer.zero_grad()
    losses.append(float(value.detach()))
print(f"loss {losses[0]:.2f} -> {losses[-1]:.2f}")
