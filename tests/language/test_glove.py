import copy
import pickle

import numpy as np
import pytest
import torch

from ldrl.language.glove import DIMENSIONS, WordEmbedding, load_glove


def line(word, values):
    return " ".join([word, *(f"{value:.5f}" for value in values)])


@pytest.fixture
def write(tmp_path):
    def write(*lines):
        path = tmp_path / "glove.6B.50d.txt"
        path.write_bytes("".join(f"{line}\n" for line in lines).encode())
        return path

    return write


def nearest(glove, word, count):
    unit = torch.nn.functional.normalize(glove.vectors, dim=1)
    rows = (unit @ unit[glove.words[word]]).topk(count + 1).indices.tolist()[1:]
    names = list(glove.words)
    return {names[row] for row in rows}


def test_the_package_holds_the_real_glove():
    glove = load_glove()
    assert glove.vectors.shape == (400_000, DIMENSIONS)
    assert glove.vectors.dtype == torch.float32
    assert list(glove.words)[:3] == ["the", ",", "."]
    # The first line of the published glove.6B.50d.txt, and its last word.
    torch.testing.assert_close(glove.vectors[0, :4], torch.tensor([0.418, 0.24968, -0.41242, 0.1217]))
    assert list(glove.words)[-1] == "sandberger"
    assert {"third", "fourth", "first"} <= nearest(glove, "second", 6)
    assert {"leaving", "back"} <= nearest(glove, "left", 6)
    assert load_glove() is glove


def test_padding_is_zero_and_unknown_the_mean():
    glove = load_glove()
    assert not glove.table[0].any()
    torch.testing.assert_close(glove.table[1], glove.vectors.mean(0), atol=1e-4, rtol=0)
    assert glove.vectors.data_ptr() == glove.table[2].data_ptr(), "vectors are a view, not a second copy"


def test_embedding_looks_up_any_batch_shape():
    glove = load_glove()
    tokens = torch.tensor([[[0, 1, 2], [glove.words["left"] + 2, 3, 0]]])
    vectors = glove.embedding()(tokens)
    assert vectors.shape == (1, 2, 3, DIMENSIONS)
    assert vectors.dtype == torch.float32
    assert torch.equal(vectors[0, 1, 0], glove.vectors[glove.words["left"]])
    assert not vectors[0, 0, 0].any()


def test_embedding_is_frozen_unsaved_and_shared():
    embedding = WordEmbedding()
    assert not embedding.state_dict()
    assert not list(embedding.parameters())
    assert not list(embedding.buffers())
    assert len(pickle.dumps(embedding)) < 2000
    for other in (copy.deepcopy(embedding), copy.copy(embedding), pickle.loads(pickle.dumps(embedding))):
        assert other.glove.table.data_ptr() == embedding.glove.table.data_ptr()


def test_embedding_follows_its_input_to_a_device():
    embedding = WordEmbedding()
    vectors = embedding(torch.ones(2, 3, dtype=torch.int64, device="meta"))
    assert vectors.device.type == "meta"
    assert vectors.shape == (2, 3, DIMENSIONS)
    device = torch.device("meta")
    assert embedding.glove.table_on(device) is WordEmbedding().glove.table_on(device)


def test_embedding_compiles_whole():
    tokens = torch.tensor([[2, 0]])
    embedding = WordEmbedding()
    compiled = torch.compile(embedding, fullgraph=True, backend="eager")
    assert torch.equal(compiled(tokens), embedding(tokens))


def test_a_text_file_gives_the_same_as_its_numbers(write):
    values = np.random.default_rng(0).normal(size=(3, DIMENSIONS))
    # U+0085 ends a line for text mode, and GloVe has it inside a word.
    path = write(line("left", values[0]), line("a\u0085b", values[1]), line("right", values[2]))
    glove = load_glove(path)
    assert glove.words == {"left": 0, "a\u0085b": 1, "right": 2}
    np.testing.assert_allclose(glove.vectors.numpy(), values, atol=1e-5)
    assert load_glove(str(path)) is glove
    assert pickle.loads(pickle.dumps(glove)) is glove


def test_malformed_files_are_refused_by_name_and_line(write):
    good = line("left", np.ones(DIMENSIONS))
    cases = {
        "line 2: expected a word and 50 numbers, found 100 fields": line("right", np.ones(100)),
        "line 2: expected a word and 50 numbers, found 0 fields": "",
        "line 2: could not convert string to float": line("right", np.ones(49)) + " one",
        "line 2: the vector of 'right' is not finite": line("right", np.ones(49)) + " nan",
        "line 2: 'left' was already on line 1": good,
    }
    for message, bad in cases.items():
        path = write(good, bad)
        with pytest.raises(ValueError, match=message) as error:
            load_glove(path)
        assert str(path) in str(error.value)


def test_files_that_are_empty_binary_or_missing(write, tmp_path):
    with pytest.raises(ValueError, match="is empty"):
        load_glove(write())
    binary = tmp_path / "binary.txt"
    binary.write_bytes(b"\xff" + line("", np.ones(DIMENSIONS)).encode())
    with pytest.raises(ValueError, match=r"binary.txt, line 1: .* can't decode"):
        load_glove(binary)
    with pytest.raises(FileNotFoundError, match=r"none.txt"):
        load_glove(tmp_path / "none.txt")
