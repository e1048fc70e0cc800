"""A model2vec model of a few words with chosen vectors: no pretrained weights are needed to test with."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np


def make_model(folder: Path, vectors: Mapping[str, Sequence[float]]) -> Path:
    """Save a static model that embeds a phrase as the mean of its words' vectors."""
    from model2vec import StaticModel
    from tokenizers import Tokenizer
    from tokenizers.models import WordLevel
    from tokenizers.pre_tokenizers import Whitespace

    tokenizer = Tokenizer(
        WordLevel({"[UNK]": 0, **{word: i for i, word in enumerate(vectors, start=1)}}, "[UNK]")
    )
    tokenizer.pre_tokenizer = Whitespace()
    unknown = [1e-6] * len(next(iter(vectors.values())))
    embedding = np.array([unknown, *vectors.values()], dtype=np.float32)
    StaticModel(embedding, tokenizer, config={}).save_pretrained(str(folder))
    return folder
