"""The command line as tests call it."""

from stga_addon.cli.main import main


def stga(*words: object) -> int:
    """Exit code of a command; texts are divided at spaces, paths and numbers are not."""
    parts = [word.split() if isinstance(word, str) else [str(word)] for word in words]
    return main([text for part in parts for text in part])
