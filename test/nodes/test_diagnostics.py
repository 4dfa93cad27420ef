# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""/diagnostics of the nodes while their input arrives, stops and fails."""

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from processes import PROJECT
from tester import make_frame

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@pytest.fixture
def status(tester):
    """The last report of the running node: level, message and values."""
    heard = []
    subscription = tester.create_subscription(DiagnosticArray, '/diagnostics', heard.append, 10)

    class Status:
        def wait(self, level, text='', work=tester.spin, **values):
            """Wait for a new report with a level, a text and values."""
            heard.clear()

            def fits():
                return any(self.fits(msg.status[0], level, text, values) for msg in heard)
            tester.feed_until(fits, work, 'the report') if isinstance(work, tuple) else \
                tester.wait(fits, f'{level} {text} {values}, last: {heard[-1:]}', 20.0)
            return {value.key: value.value for value in heard[-1].status[0].values}

        @staticmethod
        def fits(status, level, text, values):
            given = {value.key: value.value for value in status.values}
            return (status.level == level and text in status.message
                    and all(value in given.get(key, '') for key, value in values.items()))
    yield Status()
    tester.destroy_subscription(subscription)


def test_a_relocalizer_that_hears_everything_nothing_and_half(own_relocalizer, tester, status):
    own_relocalizer(mode='continuous', stale_after_s=1.0)
    frame = make_frame()
    values = status.wait(OK, 'active', frame, **{'last verdict': 'accepted: x 0.3'})
    assert values['state'] == 'active'
    assert int(values['accepted']) > 0
    assert float(values['search p99 [ms]']) >= float(values['search mean [ms]']) > 0.0
    assert {'waiting last [ms]', 'queue age [s]', 'images dropped unpaired',
            'frames skipped while busy', 'memory [MiB]'} <= set(values)
    tester.wait(lambda: float(status.wait(OK, 'active', frame)['image rate [Hz]']) > 1.0,
                'a count of images')
    status.wait(WARN, 'no image on /image for', (frame[1], frame[2]))
    status.wait(ERROR, 'no camera_info on /camera_info for', (frame[0], frame[2]))
    tester.destroy_publisher(tester.infos)
    status.wait(ERROR, 'nobody publishes /camera_info')
    tester.infos = tester.create_publisher(type(frame[1]), 'camera_info', 10)
    status.wait(OK, 'active', frame)


def test_a_detector_warns_of_silence_and_of_bad_images(start, tester, status):
    detector = start('nodes.detector', parameters={
        'model': PROJECT / 'demo/assets/yolo.onnx', 'stale_after_s': 0.5})
    detector.wait_for_output('ready after')
    values = status.wait(OK, 'active')
    assert values['listened to'] == 'False'
    image = make_frame()[0]
    with tester.hearing_detections() as detected:
        values = status.wait(OK, 'active', (image,), **{'listened to': 'True',
                                                       'detection mean [ms]': '.'})
        assert detected
        assert {'images dropped', 'queue age [s]', 'waiting last [ms]', 'memory [MiB]'} <= set(
            values)
        status.wait(WARN, 'no image on /image from its')
        bad = make_frame()[0]
        bad.encoding = 'yuv422'
        status.wait(WARN, "encoding 'yuv422' is not one of", (bad,))
        status.wait(OK, 'active', (image,))
    # it idles without subscribers, although images arrive
    status.wait(OK, 'active', (image,), **{'listened to': 'False', 'image rate [Hz]': '0.0',
                                           'detections rate [Hz]': '0.0'})
    tester.destroy_publisher(tester.images)
    status.wait(WARN, 'nobody publishes /image')
    tester.images = tester.create_publisher(type(image), 'image', 10)
