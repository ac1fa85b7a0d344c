"""A user's answers about a laboratory's files, and the questions that are still open."""

from collections.abc import Collection, Mapping

from discrepancy.errors import CampaignFileError
from reporting.words import listing

Answers = Mapping[str, Mapping[str, str]]
"""Answers by option, and by the column or file that they are about."""

OF_COLUMNS = ("column", "unit", "quantity", "scale", "zero", "gain", "hold")
"""Options that are about columns."""
OF_FILES = (
    "kind",
    "release",
    "load-place",
    "decimal",
    "date-order",
    "interval",
    "begins",
    "held-out",
)
"""Options that are about files or, under an empty name, all of them."""
OF_ALL_COLUMNS = ("zero", "gain", "hold")
"""Options about columns that may, under an empty name, be about all of them."""


class Questionnaire:
    """The answers of a user, with a list of the questions that were asked without an answer.

    Parameters
    ----------
    answers : mapping
        The answers by option and subject; the subject is a column, a file, or empty for all of
        them.

    Attributes
    ----------
    questions : dict of (str, str) to list of str
        The subjects of open questions; the key is an option, and the phrase on what it expects.
    assumptions : dict of (str, str) to dict of str to str
        The default answers that were used, by subject; the keys are those of `questions`.
    """

    def __init__(self, answers: Answers) -> None:
        self.answers = answers
        self.questions: dict[tuple[str, str], list[str]] = {}
        self.assumptions: dict[tuple[str, str], dict[str, str]] = {}

    def stated_answer(self, option: str, subject: str) -> str | None:
        """Return the user's answer about exactly this column or file; None if there is none.

        An answer for all columns or files does not count, and a missing answer is not noted as an
        open question.
        """
        return self.answers.get(option, {}).get(subject)

    def ask(
        self, option: str, subject: str, expected_answer: str, choices: Collection[str] = ()
    ) -> str:
        """Return the user's answer by an option about a column or file.

        An answer about exactly this column or file comes before one about all. If there is none,
        an open question is noted, and an empty text is returned.

        Parameters
        ----------
        option : str
            The name of the option, without dashes.
        subject : str
            The column or file; empty for all.
        expected_answer : str
            What the option expects, for the user.
        choices : collection of str
            The answers that are allowed; any if empty.

        Raises
        ------
        CampaignFileError
            If the answer is not one of the choices.
        """
        answers = self.answers.get(option, {})
        answer = answers.get(subject, answers.get(""))
        if answer is None:
            subjects = self.questions.setdefault((option, expected_answer), [])
            if subject not in subjects:
                subjects.append(subject)
            return ""
        if choices and answer not in choices:
            raise CampaignFileError(
                f"--{option} must be {listing(choices, 'or')}, but {answer!r} was given."
            )
        return answer

    def ask_or_assume(
        self,
        default: str,
        option: str,
        subject: str,
        expected_answer: str,
        choices: Collection[str] = (),
    ) -> str:
        """Return the user's answer; if there is none, note the default as assumed and return it.

        Parameters and errors are those of `ask`.
        """
        answers = self.answers.get(option, {})
        if subject not in answers and "" not in answers:
            self.assumptions.setdefault((option, expected_answer), {})[subject] = default
            return default
        return self.ask(option, subject, expected_answer, choices)

    def is_assumed(self, option: str, subject: str) -> bool:
        """Return whether the default answer of an option was used for a subject."""
        return any(
            asked_option == option and subject in defaults
            for (asked_option, _), defaults in self.assumptions.items()
        )


def check_subjects(answers: Answers, heads: Collection[str], files: Collection[str]) -> None:
    """Raise an error if an answer is about a column or a file that does not exist.

    An empty subject means all; it is allowed for `OF_FILES` and `OF_ALL_COLUMNS`.

    Parameters
    ----------
    answers : mapping
        The answers by option and subject.
    heads : collection of str
        The heads of all columns, in order.
    files : collection of str
        The names of all files, in order.

    Raises
    ------
    CampaignFileError
        If there is such an answer.
    """
    for option in (*OF_COLUMNS, *OF_FILES):
        subjects = heads if option in OF_COLUMNS else files
        allowed_subjects = {*subjects}
        if option in OF_FILES or option in OF_ALL_COLUMNS:
            allowed_subjects.add("")
        for name in answers.get(option, {}).keys() - allowed_subjects:
            expected_subjects = listing(map(repr, filter(None, subjects)), "or")
            raise CampaignFileError(
                f"--{option} must be NAME=... about {expected_subjects}, but {name!r} was given."
            )
