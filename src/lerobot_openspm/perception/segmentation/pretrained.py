"""Loading models of `transformers`, with one error that says what to do about whatever is in the way."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot_openspm.errors import PerceptionError

INSTALL = "pip install 'lerobot_policy_openspm[perception]'"
TESTED_RELEASE = "5.5.4"
# Publishers put the same weights beside them in other formats, among them pickles, which are never read.
FILES = ("*.json", "*.txt", "*.safetensors")
INCLUDE = " ".join(f"--include '{pattern}'" for pattern in FILES)
NOT_CACHED = "{name!r} is not or not wholly in the cache, and "
UNREACHABLE = (
    NOT_CACHED + "the Hugging Face Hub cannot be reached. Once, with a network: hf download {name} {include}"
)
# By exceptions of huggingface_hub and httpx, the first of them that is among the causes: what to do.
REMEDIES = {
    "GatedRepoError": "the weights {name!r} are given on request only. Ask for access at "
    "https://huggingface.co/{name}, then log in with a token: hf auth login",
    "RepositoryNotFoundError": "there is no model {name!r} on the Hugging Face Hub that you may see. Check "
    "the name at https://huggingface.co/{name}; if it is private, log in: hf auth login",
    "OfflineModeIsEnabled": NOT_CACHED + "HF_HUB_OFFLINE forbids to download it. Once, with a network: "
    "HF_HUB_OFFLINE=0 hf download {name} {include}",
    "LocalEntryNotFoundError": UNREACHABLE,
    "TransportError": UNREACHABLE,
}
NO_CHECKPOINT = (
    "{name!r} is no checkpoint of {class_name}: {error}. Give the name of one on the Hugging Face Hub, or a "
    "folder with its config.json and *.safetensors"
)


def fetch(name: str, class_name: str, device: str) -> Path:
    """Bring a model's files to this machine; everything else reads them from there.

    All at once, because transformers asks the Hub for one file after the other, and where there is no network
    waits for half a minute at each, be they in the cache or not.

    Args:
        name: On the Hugging Face Hub, or a folder.
        class_name: The class of `transformers` that is to read it, looked for before anything is downloaded.
        device: Where the model is to run, looked for likewise.

    Raises:
        PerceptionError: The package or the device is missing, the model does not exist or is given on
            request only, or it is not in the cache and there is no network.
    """
    transformers_class(class_name)
    check_device(device)
    if name and Path(name).is_dir():
        return Path(name)
    from huggingface_hub import snapshot_download

    with _explained(name, class_name):
        return Path(snapshot_download(name, allow_patterns=list(FILES)))


def load(name: str, model_name: str, processor_name: str, device: str) -> tuple[Any, Any]:
    """A pretrained model of `transformers` in evaluation mode, with all its weights, and its processor.

    Args:
        name: On the Hugging Face Hub, or a folder.
        model_name: The model's class.
        processor_name: The class of the processor of images and texts that belongs to it.
        device: Where the model is to run.

    Raises:
        PerceptionError: See :func:`fetch`; or the checkpoint is of something else, is damaged, or lacks
            weights.
    """
    folder = fetch(name, model_name, device)
    with _explained(name, model_name):
        if not (folder / "config.json").is_file():
            # transformers takes a model of the usual size then, and weights of another shape for random ones.
            raise FileNotFoundError(f"there is no config.json in {folder}")
        # Weights of another shape are reported like missing ones then, instead of a traceback.
        model, report = transformers_class(model_name).from_pretrained(
            folder, output_loading_info=True, ignore_mismatched_sizes=True, use_safetensors=True
        )
    _check_complete(report, name)
    processor_class = transformers_class(processor_name)
    with _explained(name, processor_name):
        return model.to(device).eval(), processor_class.from_pretrained(folder)


def transformers_class(name: str) -> Any:
    """A class of `transformers` by its name; imported here, because that takes seconds.

    Raises:
        PerceptionError: transformers is not installed, or too old to have it.
    """
    try:
        import transformers
    except ImportError as error:
        raise PerceptionError(f"this model needs transformers: {error}. Install it: {INSTALL}") from error
    try:
        return getattr(transformers, name)
    except (AttributeError, ImportError) as error:
        raise PerceptionError(
            f"transformers {transformers.__version__} has no {name}: {error}. Bring it up to date: {INSTALL}"
        ) from error


def check_device(device: str) -> None:
    """Raise PerceptionError on a device that PyTorch does not have here."""
    import torch

    try:
        torch.zeros(1, device=device)
    # AssertionError: what PyTorch raises where it was built without CUDA.
    except (RuntimeError, AssertionError) as error:
        raise PerceptionError(f"device {device!r} cannot be used: {error}. Use 'cpu'") from error


def _check_complete(report: Mapping[str, Any], name: str) -> None:
    """Refuse a model that was loaded in part: transformers fills gaps with random weights, and only warns.

    Some releases, for example, look for SAM 3's text encoder under names that its checkpoint does not use.
    """
    import transformers

    missing = sorted(report["missing_keys"])
    mismatched = sorted(key for key, *_ in report["mismatched_keys"])
    for what, keys in (("lacks", missing), ("has in another shape", mismatched)):
        if keys:
            more = f" and {len(keys) - 3} more" if len(keys) > 3 else ""
            raise PerceptionError(
                f"{name!r} {what} {len(keys)} weights that transformers "
                f"{transformers.__version__} expects: {', '.join(keys[:3])}{more}; the model would be random "
                f"there. Install the release that was tested: {INSTALL} 'transformers=={TESTED_RELEASE}'"
            )


@contextmanager
def _explained(name: str, class_name: str) -> Generator[None]:
    """Turn what goes wrong while loading into one PerceptionError that keeps the cause."""
    from httpx import TransportError
    from safetensors import SafetensorError

    try:
        yield
    # What the libraries are known to let through; a mistake of ours, such as a TypeError, stays one.
    except (
        OSError, ValueError, RuntimeError, ImportError, KeyError, SafetensorError, TransportError
    ) as error:  # fmt: skip
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        known = {kind.__name__ for cause in _causes(error) for kind in type(cause).__mro__}
        remedy = next((text for kind, text in REMEDIES.items() if kind in known), NO_CHECKPOINT)
        raise PerceptionError(
            remedy.format(name=name, include=INCLUDE, class_name=class_name, error=first_line)
        ) from error


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """The error and what it came from, to the first."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__
