"""The one exception a person is meant to read."""


class StgaError(Exception):
    """A mistake or a mishap outside the code: bad file, bad option, full disk.

    The message is one sentence that names the file, the field and what was expected. The command line
    prints it and exits with 2; Blender's operators report it; neither shows a traceback.
    """
