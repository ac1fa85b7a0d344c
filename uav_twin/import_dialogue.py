"""The dialogue of `discrepancy import`: one question at a time, and a command that repeats it.

The answers are those of the command's options. So all answers can be written as a command, which
repeats the import without questions or continues an interrupted dialogue.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from discrepancy.errors import CampaignFileError
from reporting import terminal
from reporting.words import counted

if TYPE_CHECKING:
    from discrepancy.campaign.importing import LaboratoryImport

HOW_TO_ANSWER = (
    "An empty line takes the value in brackets. Ctrl-C stops; the answers are kept as a command."
)


class ImportCommand:
    """The command of an import, to which the user's answers are added.

    Parameters
    ----------
    out : Path or None
        None if it was not given.
    model : str or None
        None if it was not given.
    """

    def __init__(self, files: Sequence[Path], out: Path | None, model: str | None) -> None:
        self._words = ["uav-twin", "discrepancy", "import", *map(str, files)]
        if out is not None:
            self._words += ["--out", str(out)]
        if model is not None:
            self._words += ["--model", model]

    def with_answers(self, understanding: "LaboratoryImport", *, ask_nothing: bool) -> str:
        """Return the command with all answers, to be pasted into a shell.

        Parameters
        ----------
        ask_nothing : bool
            Whether the command asks no question, even at a terminal.
        """
        words = list(self._words)
        for option, answers in understanding.answers.items():
            for subject, answer in answers.items():
                words += [f"--{option}", f"{subject}={answer}" if subject else answer]
        if ask_nothing:
            words.append("--ask-nothing")
        return shlex.join(words)


class ImportDialogue:
    """Asks at a terminal for what files and options do not say.

    Attributes
    ----------
    understanding : LaboratoryImport
        The import with all answers so far.
    """

    def __init__(self, command: ImportCommand, understanding: "LaboratoryImport") -> None:
        self._command = command
        self.understanding = understanding

    @property
    def open_count(self) -> int:
        """The number of questions still to ask; an answer may raise further ones."""
        questions = sum(len(subjects) for subjects in self.understanding.questions.values())
        return questions + sum(len(texts) for texts in self.understanding.assumptions.values())

    def ask_all(self) -> bool:
        """Ask all questions, also about assumed defaults; return whether there were any.

        Raises
        ------
        typer.Exit
            If the user stops the dialogue. The command that continues it was printed before.
        """
        has_questions = self.open_count > 0
        if has_questions:
            terminal.say(f"{counted(self.open_count, 'question')} to answer. {HOW_TO_ANSWER}")
            if self.understanding.outputs_sentence:
                terminal.say(self.understanding.outputs_sentence)
        while self.open_count > 0:
            self._ask_next()
        return has_questions

    def confirm(self, question: str) -> bool:
        """Ask a yes-or-no question, and return the answer; an empty line means yes."""
        try:
            return typer.confirm(question, default=True)
        except typer.Abort:
            raise self._stop() from None

    def print_repetition(self) -> None:
        """Print the command that repeats the import without questions."""
        command = self._command.with_answers(self.understanding, ask_nothing=True)
        terminal.say(f"To repeat it without questions: {command}")

    def _ask_next(self) -> None:
        """Ask the next question, beginning with those without a default.

        After an invalid answer the error is printed, and the question is asked again.
        """
        # Questions and assumptions have the key (option, form of its value)
        if self.understanding.questions:
            option, expected_answer = next(iter(self.understanding.questions))
            subject = self.understanding.questions[option, expected_answer][0]
            default = None
        else:
            option, expected_answer = next(iter(self.understanding.assumptions))
            subject, default = next(
                iter(self.understanding.assumptions[option, expected_answer].items())
            )
        owner = f"{subject}: " if subject else ""
        question = f"({self.open_count} open) {owner}{option.replace('-', ' ')}, {expected_answer}"
        try:
            answer: str = typer.prompt(question, default=default)
        except typer.Abort:
            raise self._stop() from None
        try:
            self.understanding = self.understanding.with_answer(option, subject, answer.strip())
        except CampaignFileError as error:
            typer.secho(str(error), fg="red", err=True)

    def _stop(self) -> typer.Exit:
        """Print the command that continues the dialogue, and return the exit of this one."""
        command = self._command.with_answers(self.understanding, ask_nothing=False)
        terminal.say("")
        terminal.say(f"Nothing was written. To go on with these answers: {command}")
        return typer.Exit(terminal.INTERRUPTED)
