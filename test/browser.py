# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Chromium with a simulated person at it, for the tests of the studio's page."""

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
    """A person at the page. The scene takes seconds per frame, so it is off unless requested."""

    def __init__(self, chromium, url, has_scene=False):
        self.page = chromium.new_page(viewport={'width': 1000, 'height': 800})
        self.page.set_default_timeout(TIMEOUT_S * 1000)
        self.foreign = []
        self.page.on('request', self.note)
        if not has_scene:
            self.page.route('**/scene/**', lambda route: route.abort())
        self.page.goto(url)
        self.page.get_by_text('landmarks in ').first.wait_for()

    def note(self, request):
        if not re.match(r'(http|ws)://127\.0\.0\.1:|data:|blob:|file:', request.url):
            self.foreign.append(request.url)

    def click(self, name):
        self.page.get_by_role('button', name=name).first.click()

    def mode(self, name):
        self.page.get_by_role('button', name=name, exact=True).first.click()

    def field(self, label):
        return self.page.get_by_label(label, exact=True).first

    def type(self, label, text):
        field = self.field(label)
        field.fill(text)
        field.press('Enter')

    def find(self, text):
        self.page.get_by_label('Find').fill(text)

    def row(self, text):
        return self.page.get_by_role('option').filter(has_text=text).first

    def select(self, document, landmark_id):
        """Find a landmark in the list, and click it."""
        self.find(landmark_id)
        self.page.get_by_role('option').filter(has_text=re.compile(f'^{landmark_id} ')).click()
        wait_for(lambda: document.selection == (landmark_id,), 'the selection')

    def show_view(self, studio, view):
        self.page.evaluate(f"send('show_view', {{view: {view}}})")
        wait_for(lambda: studio.view == view, 'the view')
        self.page.get_by_text(re.compile(f'^view {view + 1} of ')).first.wait_for()

    def on_image(self, pixel):
        """Return the position on the page of a pixel (2,) of the image."""
        return self.page.evaluate("""([x, y]) => {
            const at = new DOMPoint(x, y).matrixTransform($('image').getScreenCTM());
            return [at.x, at.y];}""", [float(value) for value in pixel])

    def drag(self, start, end):
        """Drag from one point of the page to another; the button stays down."""
        self.page.mouse.move(*start)
        self.page.mouse.down()
        self.page.mouse.move(*[0.5 * (one + other) for one, other in zip(start, end, strict=True)],
                             steps=4)
        self.page.mouse.move(*end, steps=4)

    def draw_box(self, studio, view, box):
        """Draw a box (4,) [px] in a view."""
        self.show_view(studio, view)
        self.drag(self.on_image(box[:2]), self.on_image(box[2:]))
        self.page.mouse.up()
        wait_for(lambda: view in studio.new.boxes, 'the box')

    def picture(self, name):
        """Save a picture of the page if the environment names a folder for it."""
        if folder := os.environ.get('CLIPLOC_SCREENSHOTS'):
            self.page.screenshot(path=Path(folder) / f'{name}.png', timeout=TIMEOUT_S * 1000)
