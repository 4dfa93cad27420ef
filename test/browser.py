# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Chromium, and a person in front of it, for the tests of the studio's page."""

import os
import re
import shutil
import time
from contextlib import contextmanager
from pathlib import Path

# WebGL without a GPU. The sandbox needs privileges that root in a container lacks.
OPTIONS = ('--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader',
           '--enable-unsafe-swiftshader')
# Software rendering on a busy machine takes seconds a frame.
TIMEOUT_S = 60.0


def wait_for(condition, what):
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline, f'timed out: {what}'
        time.sleep(0.05)


@contextmanager
def running_chromium():
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which('chromium'),
                                              args=list(OPTIONS))
        yield browser
        browser.close()


class Person:
    """Who looks at the page."""

    def __init__(self, chromium, url):
        self.page = chromium.new_page(viewport={'width': 1000, 'height': 800})
        self.page.set_default_timeout(TIMEOUT_S * 1000)
        self.foreign = []
        self.page.on('request', self.note)
        self.page.goto(url)
        self.page.get_by_text('landmarks in map').wait_for()

    def note(self, request):
        if not re.match(r'(http|ws)://127\.0\.0\.1:|data:|blob:', request.url):
            self.foreign.append(request.url)

    def click(self, name):
        self.page.get_by_role('button', name=name).first.click()

    def field(self, label, number=0):
        """Return an input of the row with a label."""
        row = self.page.get_by_text(label, exact=True).locator('xpath=../../..')
        return row.locator('input:not([type=hidden])').nth(number)

    def type(self, label, text, number=0):
        field = self.field(label, number)
        field.fill(text)
        field.press('Enter')

    def find(self, text):
        self.field('Find').fill(text)

    def select(self, document, landmark_id):
        """Find a landmark in the table, and click it."""
        self.find(landmark_id)
        self.click(re.compile(f'^{landmark_id} '))
        wait_for(lambda: document.selection == (landmark_id,), 'the selection')

    def draw_box(self, studio, server, view, box):
        """Type the corners of a box (4,) [px] in a view."""
        self.type('View', str(view))
        wait_for(lambda: studio.view == view, 'the view')
        for place, pixel in enumerate(round(float(edge)) for edge in box):
            label, number = ('Left, top [px]', 'Right, bottom [px]')[place // 2], place % 2
            self.type(label, str(pixel), number)
            # viser's page loses a value if another one follows within milliseconds
            wait_for(lambda label=label, number=number, pixel=pixel: value_of(
                server, label)[number] == pixel, 'the corner')
        self.click('Draw this box')
        wait_for(lambda: view in studio.drawn, 'the box')

    def name_new(self, server, label, class_id):
        """Type label and class of the landmark that is to be created."""
        for field, text in (('New label', label), ('New class', class_id)):
            self.type(field, text)
            wait_for(lambda field=field, text=text: value_of(server, field) == text, field)

    def picture(self, name):
        """Keep a picture of the page where the environment names a folder for it."""
        if folder := os.environ.get('CLIPLOC_SCREENSHOTS'):
            self.page.screenshot(path=Path(folder) / f'{name}.png', timeout=TIMEOUT_S * 1000)


def value_of(server, label):
    """Return what the studio knows of a field."""
    return next(handle.value for handle in server.gui._gui_input_handle_from_uuid.values()
                if getattr(handle, 'label', '') == label)
