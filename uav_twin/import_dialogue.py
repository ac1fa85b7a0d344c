"""The dialogue of `uav-twin discrepancy import`: one question at a time, and the command that repeats it.

The answers are those of the options of the command. So whatever was answered can be written as a
command, which repeats the import without a question or goes on with an interrupted dialogue.
"""  # noqa: E501

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
    """The command of an import, to which the answers of the user are added.

    Parameters
    ----------
    files : sequence of Path
        The files of the laboratory, as they were given.
    out : Path or None
        The folder of the campaign, if it was given.
    model : str or None
        The model, if it was given.
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
        understanding : LaboratoryImport
            The import with its answers.
        ask_nothing : bool
            Whether the command asks nothing, even at a terminal.
        """
        words = list(self._words)
        for option, answers in understanding.answers.items():
            for subject, answer in answers.items():
                words += [f"--{option}", f"{subject}={answer}" if subject else answer]
        if ask_nothing:
            words.append("--ask-nothing")
        return shlex.join(words)


class ImportDialogue:
    """Asks at a terminal what the files and the options of a command leave open.

    Parameters
    ----------
    command : ImportCommand
        The command of the import.
    understanding : LaboratoryImport
        The import before the first question.

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
        """The number of questions that are open now; an answer may raise further questions."""
        questions = sum(len(subjects) for subjects in self.understanding.questions.values())
        return questions + sum(len(texts) for texts in self.understanding.assumptions.values())

    def ask_all(self) -> bool:
        """Ask all open questions; return whether there were any.

        Assumptions are defaults that the user may change; they are asked, too.

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
        """Ask whether to do something, and return the answer; an empty line is a yes."""
        try:
            return typer.confirm(question, default=True)
        except typer.Abort:
            raise self._stop() from None

    def print_repetition(self) -> None:
        """Print the command that repeats the import without questions."""
        command = self._command.with_answers(self.understanding, ask_nothing=True)
        terminal.say(f"To repeat it without questions: {command}")

    def _ask_next(self) -> None:
        """Ask the next question; questions without a default come first.

        After an invalid answer the error is printed, and the question stays open.
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
        """Print the command that goes on with the dialogue, and return the end of this one."""
        command = self._command.with_answers(self.understanding, ask_nothing=False)
        terminal.say("")
        terminal.say(f"Nothing was written. To go on with these answers: {command}")
        return typer.Exit(terminal.INTERRUPTED)
