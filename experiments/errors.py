"""Tell mistakes of the user, or of the machine, from mistakes of the program."""


class UserError(ValueError):
    """Something that the person at the keyboard can mend; the command line shows it as one line."""
