"""Messages that can be printed, of a length that can be read."""

from stga_addon.errors import MAX_MESSAGE_CHARACTERS, MAX_VALUE_CHARACTERS, StgaError, shorten


def test_message_can_be_printed_and_read():
    """Catches a message that no terminal or log file can encode, because a path in it holds a lone
    surrogate; one of megabytes, and one whose beginning or end is lost with the middle."""
    assert str(StgaError("a\ud800b: does not exist")) == "a\\ud800b: does not exist"
    message = str(StgaError("capture: " + "x" * 1_000_000 + " is too long"))
    assert len(message) <= MAX_MESSAGE_CHARACTERS
    assert message.startswith("capture: x")
    assert message.endswith("is too long")


def test_quoted_values_are_short():
    """Catches values of a file that are quoted whole, whatever they are, and a ValueError for whole
    numbers of more digits than Python writes."""
    nested = [[[[1] * 50] * 50] * 50] * 50
    for value in ("x" * 10**6, ["y" * 10**6] * 100, {"k" * 1000: [1] * 1000}, 10**4000, nested):
        assert len(shorten(value)) <= MAX_VALUE_CHARACTERS
    assert shorten("left") == "'left'"
    assert shorten(10**5000) == "a number of too many digits"
