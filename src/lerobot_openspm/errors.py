"""The exceptions of the project. World faults (an object not found, no progress) are statuses, not these."""


class OpenSPMError(ValueError):
    """Base of every error raised on bad input. Says what, got, expected, where, and what to do next."""


class CalibrationError(OpenSPMError):
    """A camera calibration is missing, malformed, or does not fit the images."""


class LayoutError(OpenSPMError):
    """State or action vectors are not laid out as the configuration or the feature names say."""


class DatasetError(OpenSPMError):
    """A dataset cannot be mined: features are missing, or no episode yields key poses."""


class MemoryFormatError(OpenSPMError):
    """A memory on disk is truncated, malformed, or of a newer version."""


class InstructionError(OpenSPMError):
    """An instruction that the memory holds no entry for."""


class LexiconError(OpenSPMError):
    """A file of words is missing, or holds what does not belong there."""


class ObservationError(OpenSPMError):
    """An observation lacks a camera, has images of another size, or is not finite."""


class PerceptionError(OpenSPMError):
    """A perception backend cannot be used: a package, weights, a worker or a phrase is missing."""


class PhaseLabelError(OpenSPMError):
    """A judge of phases cannot be used, or gave no usable answer."""
