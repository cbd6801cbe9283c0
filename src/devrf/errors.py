"""The project's own error type: what a user can put right, said in one line."""


class DevrfError(Exception):
    """A mistake in the input (a file, a key, a checkpoint) that the user can put right.

    The message is one line: it names the file or key, what was expected, and what to do.
    The command line prints it and exits with status 2; nothing has been half-written.
    """
