"""What refuses a request, and what is wrong with a file."""


class Refused(ValueError):
    """The request makes no sense for this run; nothing was moved."""


class JournalError(RuntimeError):
    """The journal cannot be written, or is damaged."""
