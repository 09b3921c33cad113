"""The two encoders."""

import pytest
import torch

from ldrl.language import Likeness, Tokenizer, WordEmbedding
from ldrl.modules import ImageEncoder, InstructionEncoder

LEARNED = {"learned", "forward_gru", "backward_gru"}


@pytest.fixture
def encoder():
    torch.manual_seed(0)
    return InstructionEncoder(6).eval()


@pytest.mark.parametrize(("rows", "channels"), [(88, (2, 3, 4)), (88, (8, 2, 5)), (48, (2, 3, 4))])
def test_image_features(rows, channels):
    encoder = ImageEncoder(3, channels, rows)
    images = torch.randint(0, 256, (2, 5, 3, 88, 200), dtype=torch.uint8)
    features = encoder(images)
    assert features.shape[:3] == (2, 5, channels[-1])
    assert features[0, 0].numel() == encoder.out_features
    for i in range(2):
        alone = images[i, 3, :, 88 - rows :].float() / 255
        road = alone[:, -10:, 60:140].mean((1, 2), keepdim=True)
        alone = (alone - road) / (alone[:, ::4, ::4].std() + 0.03)
        torch.testing.assert_close(features[i, 3], encoder.layers(alone.unsqueeze(0))[0])
    assert features.requires_grad


def test_the_road_itself_is_seen_as_it_is():
    encoder = ImageEncoder(1, (2, 3, 4), 48)
    image = torch.randint(0, 2, (2, 1, 88, 200), dtype=torch.uint8) * 255
    torch.testing.assert_close(encoder(image), encoder.layers(image[:, :, -48:].float() / 255))


def test_light_does_not_matter_and_contrast_hardly():
    encoder = ImageEncoder(3, (2, 3, 4), 48)
    image = torch.randint(60, 120, (1, 3, 88, 200), dtype=torch.uint8)
    torch.testing.assert_close(encoder(image + 60), encoder(image), atol=1e-4, rtol=1e-4)
    dim = (image - 60) * 3
    assert (encoder(dim) - encoder(image)).abs().max() < 0.3 * encoder(image).abs().max()


def test_paper_size_of_image_features():
    assert ImageEncoder(1, (2, 2, 64)).out_features == 64 * 3 * 10


def test_only_the_lower_rows_are_seen():
    encoder = ImageEncoder(1, (2, 3, 4), 48)
    image = torch.randint(0, 256, (1, 1, 88, 200), dtype=torch.uint8)
    sky, road = image.clone(), image.clone()
    sky[..., :40, :] = 255 - sky[..., :40, :]
    road[..., 40, :] = 255 - road[..., 40, :]
    assert torch.equal(encoder(sky), encoder(image))
    assert not torch.equal(encoder(road), encoder(image))


def test_images_are_not_changed():
    image = torch.full((1, 1, 88, 200), 255, dtype=torch.uint8)
    ImageEncoder(1, (2, 3, 4))(image)
    assert (image == 255).all()


def test_words_against_the_plain_recurrence(encoder):
    tokens = Tokenizer(max_tokens=7)(["turn left", "take the second zebra please", "straight"])
    states, is_word = encoder(tokens)
    assert states.shape == (3, 5, 6)
    for gru, half in ((encoder.forward_gru, slice(0, 3)), (encoder.backward_gru, slice(3, 6))):
        cell = torch.nn.GRUCell(66 + 28, 3)
        cell.load_state_dict({name.removesuffix("_l0"): value for name, value in gru.state_dict().items()})
        for row, length in enumerate((2, 5, 1)):
            state = torch.zeros(1, 3)
            for k in range(length) if gru is encoder.forward_gru else reversed(range(length)):
                # Vectors that are learned: of usual words, and zeros for all others.
                which = (encoder.usual_tokens == tokens[row, k]).nonzero().flatten()
                learned = encoder.learned.weight[which[0] + 1] if len(which) else torch.zeros(16)
                vector = torch.cat((WordEmbedding()(tokens[row, k]), learned, Likeness()(tokens[row, k])))
                state = cell(vector.unsqueeze(0), state)
                torch.testing.assert_close(states[row, k, half], state[0])
    for row, length in enumerate((2, 5, 1)):
        assert is_word[row].tolist() == [True] * length + [False] * (5 - length)
        assert not states[row, length:].any()


def test_usual_words_have_a_learned_vector(encoder):
    tokenizer = Tokenizer(max_tokens=1)
    usual = tokenizer(["left", "right", "first", "second", "followed", "following", "the"])
    assert torch.isin(usual, encoder.usual_tokens).all()
    assert not torch.isin(tokenizer(["zebra", "zzyzzyx"]), encoder.usual_tokens).any()
    assert len(encoder.usual_tokens.unique()) == 1000
    encoder.noise, encoder.dropout.p = 0.0, 1.0
    first = encoder(usual)[0]
    with torch.no_grad():
        encoder.learned.weight[1:] += 1
    assert not torch.equal(encoder(usual)[0], first)
    # In training a share of them is left out; here all are, and GloVe's vectors with them, but never what looks alike.
    encoder.dropout.forward = lambda vectors: vectors  # it drops components, too
    encoder.train()
    states = encoder(usual)[0]
    assert not torch.equal(states[0], states[-1])
    encoder.likeness.forward = lambda tokens: torch.zeros(*tokens.shape, 28)
    states = encoder(usual)[0]
    assert torch.equal(states[0], states[-1])


def test_padding_and_batch_do_not_matter(encoder):
    sentences = ["turn left", "take the second right please", "zzyzzyx left"]
    states, _ = encoder(Tokenizer(max_tokens=6)(sentences))
    longer, _ = encoder(Tokenizer(max_tokens=40)(sentences))
    torch.testing.assert_close(longer, states)
    for row, sentence in enumerate(sentences):
        alone, _ = encoder(Tokenizer(max_tokens=6)([sentence]))
        torch.testing.assert_close(alone[0], states[row, : len(sentence.split())])


def test_any_batch_shape(encoder):
    tokens = Tokenizer(max_tokens=4)(["left", "go right", "turn", "second left", "take it", "a left"])
    nested, is_word = encoder(tokens.view(2, 3, 4))
    torch.testing.assert_close(nested.view(6, 2, 6), encoder(tokens)[0])
    assert torch.equal(is_word.view(6, 2), tokens[:, :2] != 0)


def test_nothing_but_padding(encoder):
    tokens = Tokenizer(max_tokens=4)(["turn left", "right"])
    tokens[1] = 0
    states, is_word = encoder(tokens)
    assert not is_word[1].any()
    assert states.isfinite().all()
    states[0].sum().backward()
    assert encoder.backward_gru.weight_ih_l0.grad.isfinite().all()


def test_words_are_disturbed_in_training_only(encoder):
    tokens = Tokenizer(max_tokens=4)(["turn left", "right"])
    quiet, _ = encoder(tokens)
    assert torch.equal(encoder(tokens)[0], quiet)
    encoder.train()
    noisy, is_word = encoder(tokens)
    assert not torch.allclose(noisy[0, 0], quiet[0, 0])
    assert not noisy[~is_word].any()
    assert torch.equal(encoder.eval()(tokens)[0], quiet)


def test_word_vectors_are_not_trained_and_not_saved(encoder):
    assert {name.split(".")[0] for name in encoder.state_dict()} == {"usual_tokens", *LEARNED}
    assert {name.split(".")[0] for name, _ in encoder.named_parameters()} == LEARNED
