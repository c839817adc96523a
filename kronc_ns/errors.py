"""The one exception that users see: a message that names the value, what was expected and the remedy."""


class KroncError(ValueError):
    """An error the user can mend; the command line prints its one-line message and exits with status 2."""
