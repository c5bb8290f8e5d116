"""The errors that a user can cause. The commands print their text alone, without a traceback."""


class InputError(ValueError):
    """Bad input: a file, a field, an option. The text is one sentence that says what is wrong, where, and what to do.

    The commands exit with code 2.
    """


class NoAdapterError(RuntimeError):
    """No graphics adapter was found (or none of the name asked for). The commands exit with code 3."""
