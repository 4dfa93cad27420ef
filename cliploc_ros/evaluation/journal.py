# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What of a run is done, so that one that was stopped can go on."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cliploc_ros.errors import OptionsError
from cliploc_ros.evaluation.trials import Result
from cliploc_ros.files.storage import replace_file


class Journal:
    """A file of results, a line for each part of a run, after a line that says what run it is."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def exists(self) -> bool:
        """Return whether an unfinished run is here."""
        return self._path.exists()

    def read(self, run: Mapping[str, Any]) -> list[Result]:
        """Return the results of an unfinished run.

        Parameters
        ----------
        run : mapping
            Description of the run, as JSON keeps it.

        Raises
        ------
        OptionsError
            The file belongs to another run (names what differs), or is damaged.
        """
        done: list[Result] = []
        try:
            header, *lines = self._path.read_text(encoding='utf-8').splitlines()
            begun = json.loads(header)
            for number, line in enumerate(lines, start=1):
                try:
                    done += [Result(**fields) for fields in json.loads(line)]
                except json.JSONDecodeError:
                    if number < len(lines):
                        raise  # the last line only may be cut off
        except OSError as error:
            raise OptionsError(f'{self._path}: cannot be read: {error.strerror}') from error
        except (ValueError, TypeError) as error:
            raise OptionsError(f'{self._path}: is damaged; remove it to start again') from error
        differing = [key for key in run if begun.get(key) != run[key]]
        if differing:
            raise OptionsError(f'{self._path}: was begun with another {" and ".join(differing)}; '
                               'give the same, or remove it to start again')
        return done

    @contextmanager
    def writing(self, run: Mapping[str, Any], done: Sequence[Result]) -> Iterator['Journal']:
        """Open the file for results, and write those that are done.

        Raises
        ------
        OptionsError
            It cannot be written.
        """
        try:
            with replace_file(self._path) as partial:  # results of hours stay on a full disk
                partial.write_text(json.dumps(run) + '\n' + (_line(done) if done else ''))
            self._file = self._path.open('a', encoding='utf-8')
        except OSError as error:
            raise self._unwritable(error) from error
        try:
            yield self
        finally:
            with suppress(OSError):  # of a full disk, which was reported when it happened
                self._file.close()

    def add(self, results: Sequence[Result]) -> None:
        """Write the results of a part.

        Raises
        ------
        OptionsError
            They cannot be written.
        """
        try:
            self._file.write(_line(results))
            self._file.flush()
        except OSError as error:
            raise self._unwritable(error) from error

    def remove(self) -> None:
        """Remove the file; the run is finished."""
        self._path.unlink(missing_ok=True)

    def _unwritable(self, error: OSError) -> OptionsError:
        return OptionsError(f'{self._path}: cannot be written: {error.strerror}; make room and '
                            'continue with --resume')


def _line(results: Sequence[Result]) -> str:
    return json.dumps([result.as_dict() for result in results]) + '\n'
