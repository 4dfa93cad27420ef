# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A bar on the terminal for work in stages."""

from types import TracebackType


class StageBar:
    """A bar that names the stage; nothing where there is no terminal."""

    def __enter__(self) -> 'StageBar':
        """Show the bar."""
        from tqdm import tqdm  # late, so that --help is fast

        self._bar = tqdm(total=100, disable=None, bar_format='{desc}: {percentage:3.0f} % |{bar}|')
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 traceback: TracebackType | None) -> None:
        """Close the bar."""
        self._bar.close()

    def show(self, stage: str, share: float) -> None:
        """Show a stage and how much of it is done, 0 to 1."""
        self._bar.set_description_str(stage, refresh=False)
        self._bar.n = round(100 * share)
        self._bar.refresh()
