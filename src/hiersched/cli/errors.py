"""What ends a command with one message."""


class InputError(Exception):
    """The input is at fault; the message says what and what is allowed."""
