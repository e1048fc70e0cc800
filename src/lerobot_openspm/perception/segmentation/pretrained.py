"""Loading models of `transformers`, with one error that says what to do about whatever is in the way."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_openspm.errors import PerceptionError

INSTALL = "pip install 'lerobot_policy_openspm[perception]'"
TESTED_RELEASE = "5.5.4"


def transformers_class(name: str) -> Any:
    """A class of `transformers` by its name; imported here, because that takes seconds.

    Raises:
        PerceptionError: transformers is not installed, or too old to have it.
    """
    try:
        import transformers
    except ImportError as error:
        raise PerceptionError(f"this segmenter needs transformers: {error}. Install it: {INSTALL}") from error
    try:
        return getattr(transformers, name)
    except (AttributeError, ImportError) as error:
        raise PerceptionError(
            f"transformers {transformers.__version__} has no {name}: {error}. Bring it up to date: {INSTALL}"
        ) from error


def load_model(class_name: str, name: str, device: str) -> Any:
    """A pretrained model in evaluation mode, every one of its weights from the checkpoint.

    Args:
        class_name: Of `transformers`.
        name: On the Hugging Face Hub, or a folder.
        device: As PyTorch names it, such as ``"cpu"`` or ``"cuda"``.

    Raises:
        PerceptionError: The package, the device or the weights are missing, or the checkpoint lacks weights.
    """
    model_class = transformers_class(class_name)
    check_device(device)
    with _explained(name, class_name):
        # Weights of another shape are reported like missing ones then, instead of a traceback.
        model, report = model_class.from_pretrained(
            name, output_loading_info=True, ignore_mismatched_sizes=True, use_safetensors=True
        )
    check_complete(report, name)
    return model.to(device).eval()


def load_processor(class_name: str, name: str) -> Any:
    """The processor of images and texts that belongs to a pretrained model.

    Raises:
        PerceptionError: The package or the processor's files are missing.
    """
    processor_class = transformers_class(class_name)
    with _explained(name, class_name):
        return processor_class.from_pretrained(name)


def check_complete(report: Mapping[str, Any], name: str) -> None:
    """Refuse a model that was loaded in part: transformers fills gaps with random weights, and only warns.

    Some releases, for example, look for SAM 3's text encoder under names that its checkpoint does not use.

    Args:
        report: What ``from_pretrained(..., output_loading_info=True)`` tells of the loading.
        name: The checkpoint's, for the error.

    Raises:
        PerceptionError: Weights are missing from the checkpoint, or have another shape there.
    """
    missing = sorted(report["missing_keys"])
    mismatched = sorted(key for key, *_ in report["mismatched_keys"])
    for what, keys in (("lacks", missing), ("has in another shape", mismatched)):
        if keys:
            import transformers

            more = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
            raise PerceptionError(
                f"{name!r} {what} {len(keys)} weights that transformers {transformers.__version__} expects: "
                f"{', '.join(keys[:3])}{more}; the model would be random there. Install the release that was "
                f"tested: {INSTALL} 'transformers=={TESTED_RELEASE}', or download the weights again: "
                f"hf download {name} --force-download"
            )


def check_device(device: str) -> None:
    """Raise PerceptionError on a device that PyTorch does not have here."""
    import torch

    try:
        torch.zeros(1, device=device)
    # AssertionError: what PyTorch raises where it was built without CUDA.
    except (RuntimeError, AssertionError) as error:
        raise PerceptionError(f"device {device!r} cannot be used: {error}. Use 'cpu'") from error


@contextmanager
def _explained(name: str, class_name: str) -> Generator[None]:
    """Turn what goes wrong while loading into one PerceptionError that keeps the cause."""
    from safetensors import SafetensorError

    try:
        yield
    # Everything that transformers is known to let through; a mistake of ours, such as a TypeError, stays one.
    except (OSError, ValueError, RuntimeError, ImportError, KeyError, SafetensorError) as error:
        raise PerceptionError(_explanation(error, name, class_name)) from error


def _explanation(error: Exception, name: str, class_name: str) -> str:
    from huggingface_hub.errors import (
        GatedRepoError,
        LocalEntryNotFoundError,
        OfflineModeIsEnabled,
        RepositoryNotFoundError,
    )

    causes = tuple(_causes(error))
    page = f"https://huggingface.co/{name}"
    # A gated repository is to huggingface_hub a special case of one that is not found.
    if any(isinstance(cause, GatedRepoError) for cause in causes):
        return (
            f"the weights {name!r} are given on request only. Ask for access at {page}, then log in with a "
            "token: hf auth login"
        )
    if any(isinstance(cause, RepositoryNotFoundError) for cause in causes):
        return (
            f"there is no model {name!r} on the Hugging Face Hub that you may see. Check the name at {page}; "
            "if it is private, log in: hf auth login"
        )
    if any(isinstance(cause, OfflineModeIsEnabled) for cause in causes):
        return (
            f"{name!r} is not wholly in the cache, and HF_HUB_OFFLINE forbids to download it. Once, with a "
            f"network: HF_HUB_OFFLINE=0 hf download {name}"
        )
    # LocalEntryNotFoundError comes with the offline mode too, hence last.
    if any(isinstance(cause, LocalEntryNotFoundError | ConnectionError) for cause in causes):
        return (
            f"{name!r} is not wholly in the cache, and the Hugging Face Hub cannot be reached. Once, with a "
            f"network: hf download {name}"
        )
    where = "the folder" if Path(name).is_dir() else "the model"
    return (
        f"{where} {name!r} is no checkpoint of {class_name}: {str(error).splitlines()[0]}. Give the name of "
        "one on the Hub, or its folder with config.json and *.safetensors"
    )


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """The error and what it came from, to the first."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
