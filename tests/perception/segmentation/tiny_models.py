"""Models of the segmentation backends with random weights, a few layers deep, and tokenizers of a few words.

They have every part of the real ones, so that what surrounds them runs as it does with real weights. What
they find means nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers, processors

WORDS = ("red", "block", "cup", "mug", "top", "drawer", "of", "the", "cabinet", ".")
WIDTH = 32


@dataclass(frozen=True)
class TinyModel:
    """A model in evaluation mode and its processor."""

    model: Any
    processor: Any


def _seeded(make: Callable[[], Any]) -> Any:
    """Make a model, its weights drawn from a seed of their own."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return make().eval()


def _tokenizer(begin: str, end: str, unknown: str, pad: str, lower: bool) -> Any:
    special = list(dict.fromkeys((pad, begin, end, unknown)))
    vocabulary = {word: number for number, word in enumerate((*special, *WORDS))}
    words = Tokenizer(models.WordLevel(vocabulary, unk_token=unknown))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    if lower:
        words.normalizer = normalizers.Lowercase()
    words.post_processor = processors.TemplateProcessing(
        single=f"{begin} $A {end}", special_tokens=[(token, vocabulary[token]) for token in (begin, end)]
    )
    names = {"bos_token": begin, "eos_token": end, "unk_token": unknown, "pad_token": pad}
    return transformers.PreTrainedTokenizerFast(tokenizer_object=words, **names)


def sam3(image_px: int = 112) -> TinyModel:
    """SAM 3 for images of 8 x 8 patches of 14 pixels."""
    tokenizer = _tokenizer("<|startoftext|>", "<|endoftext|>", "[UNK]", "<|endoftext|>", lower=False)
    cells = image_px // 14
    small = {"hidden_size": WIDTH, "num_layers": 1, "num_attention_heads": 2, "intermediate_size": 64}
    backbone = {
        "hidden_size": WIDTH,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "image_size": image_px,
        "pretrain_image_size": image_px,
        "window_size": 4,
        "global_attn_indexes": [1],
    }
    text = {
        "vocab_size": len(tokenizer),
        "hidden_size": WIDTH,
        "intermediate_size": 64,
        "projection_dim": WIDTH,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "max_position_embeddings": 32,
        "bos_token_id": tokenizer.bos_token_id,
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
    }
    config = transformers.Sam3Config(
        vision_config={
            "backbone_config": backbone,
            "fpn_hidden_size": WIDTH,
            "backbone_feature_sizes": [[4 * cells] * 2, [2 * cells] * 2, [cells] * 2],
        },
        text_config=text,
        geometry_encoder_config=small,
        detr_encoder_config=small,
        detr_decoder_config={**small, "num_queries": 8},
        mask_decoder_config={"hidden_size": WIDTH, "num_attention_heads": 2},
    )
    images = transformers.Sam3ImageProcessor(size={"height": image_px, "width": image_px})
    model = _seeded(lambda: transformers.Sam3Model(config))
    return TinyModel(model, transformers.Sam3Processor(images, tokenizer))


def grounding_dino() -> TinyModel:
    """Grounding DINO with a Swin backbone of one layer a stage and a BERT of one."""
    tokenizer = _tokenizer("[CLS]", "[SEP]", "[UNK]", "[PAD]", lower=True)
    text = transformers.BertConfig(
        vocab_size=len(tokenizer),
        hidden_size=WIDTH,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=64,
        max_position_embeddings=64,
        pad_token_id=tokenizer.pad_token_id,
    )
    backbone = transformers.SwinConfig(
        image_size=96,
        embed_dim=16,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 2, 2],
        window_size=4,
        out_features=["stage2", "stage3", "stage4"],
    )
    config = transformers.GroundingDinoConfig(
        backbone_config=backbone,
        text_config=text,
        d_model=WIDTH,
        num_queries=20,
        encoder_layers=1,
        decoder_layers=2,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        encoder_ffn_dim=64,
        decoder_ffn_dim=64,
        max_text_len=32,
    )
    images = transformers.GroundingDinoImageProcessor(size={"shortest_edge": 96, "longest_edge": 128})
    model = _seeded(lambda: transformers.GroundingDinoForObjectDetection(config))
    return TinyModel(model, transformers.GroundingDinoProcessor(images, tokenizer))


def sam2(image_px: int = 128) -> TinyModel:
    """SAM 2.1 with a Hiera backbone of five blocks."""
    cells = image_px // 16
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        num_attention_heads=1,
        image_size=[image_px, image_px],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 1, 1],
        window_size_per_stage=[8, 4, 4, 4],
        global_attention_blocks=[3],
    )
    config = transformers.Sam2Config(
        vision_config=transformers.Sam2VisionConfig(
            backbone_config=backbone,
            backbone_channel_list=[64, 32, 16, 8],
            backbone_feature_sizes=[[4 * cells] * 2, [2 * cells] * 2, [cells] * 2],
            fpn_hidden_size=WIDTH,
        ),
        prompt_encoder_config={"hidden_size": WIDTH, "image_size": image_px, "mask_input_channels": 4},
        mask_decoder_config={
            "hidden_size": WIDTH,
            "mlp_dim": 64,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": WIDTH,
        },
    )
    images = transformers.Sam2ImageProcessor(
        size={"height": image_px, "width": image_px},
        mask_size={"height": image_px // 4, "width": image_px // 4},
    )
    return TinyModel(_seeded(lambda: transformers.Sam2Model(config)), transformers.Sam2Processor(images))
