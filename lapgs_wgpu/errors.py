"""The errors that a user can cause. The commands print their text alone, without a traceback."""

_MOST = 2000  # characters of a text


class InputError(ValueError):
    """Bad input: a file, a field, an option. The text is one sentence that says what is wrong, where, and what to do.

    Names and values in it come from files of strangers: what is not printable is escaped, so that the text stays on one
    line and no terminal obeys it, and the middle of a very long one is left out. The commands exit with code 2.
    """

    def __init__(self, text: str) -> None:
        if len(text) > _MOST:
            text = f"{text[: _MOST // 2]}...{text[-_MOST // 2 :]}"
        if not text.isprintable():
            text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
        super().__init__(text)


class NoAdapterError(RuntimeError):
    """No graphics adapter was found (or none of the name asked for). The commands exit with code 3."""


def shown(value: object) -> str:
    """A value that stands in a stranger's file, as an error shows it."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a number of thousands of digits, a thousand lists in each other
        text = f"a {type(value).__name__} too large to show"
    return text if len(text) <= 80 else f"{text[:77]}..."
