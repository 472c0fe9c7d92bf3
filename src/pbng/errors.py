"""The one exception that bad input raises."""


class InputError(ValueError):
    """Input that cannot be used; the message names the offending thing and what was expected."""
