"""The errors that a user can cause or meet. The commands print their text alone, without a traceback."""


class InputError(ValueError):
    """Bad input: a file, a field, an option. The text is one sentence that says what is wrong, where, and what to do.

    The commands exit with code 2.
    """


class NoAdapterError(RuntimeError):
    """No graphics adapter was found (or none of the name asked for). The commands exit with code 3."""


class DeviceError(RuntimeError):
    """The device cannot go on with what it was given. The commands exit with code 4."""


class DeviceMemoryError(DeviceError, MemoryError):
    """A buffer or a binding is too large for the device, or its memory is used up."""


class DeviceLostError(DeviceError):
    """The device is gone: its driver gave up, or it was removed. Nothing on it can be used again."""


class NumericalError(ArithmeticError):
    """A training has values that are not finite, and does not get over it. The commands exit with code 5."""
