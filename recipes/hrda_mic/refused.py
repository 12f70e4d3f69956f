"""The one error of this recipe: a sentence that says what is wrong, and the cure."""


class Refused(Exception):
    """What a trainer would stumble over, minutes or days later."""
