# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Both nodes are managed: every transition via the real services, in any order."""

import os
import signal
import time

import pytest
from diagnostic_msgs.msg import KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from processes import PROJECT
from tester import class_matching, make_frame

IDS = {'configure': Transition.TRANSITION_CONFIGURE, 'activate': Transition.TRANSITION_ACTIVATE,
       'deactivate': Transition.TRANSITION_DEACTIVATE, 'cleanup': Transition.TRANSITION_CLEANUP}
WAY_TO = {'unconfigured': (), 'inactive': ('configure',), 'active': ('configure', 'activate')}


class Manager:
    """Drives one node as Nav2's lifecycle manager does."""

    def __init__(self, tester, name):
        self._tester = tester
        self._change = tester.create_client(ChangeState, f'/{name}/change_state')
        self._get = tester.create_client(GetState, f'/{name}/get_state')
        for client in (self._change, self._get):
            tester.wait(client.service_is_ready, client.srv_name)
        # ready here does not mean ready there, so the first answers may be lost
        asked = []

        def answered():
            if not asked or time.monotonic() > asked[-1][0] + 2.0:
                asked.append((time.monotonic(), self._get.call_async(GetState.Request())))
            return any(future.done() for _, future in asked)
        tester.wait(answered, 'a state')

    def change(self, transition_id, label=''):
        request = ChangeState.Request(transition=Transition(id=transition_id, label=label))
        return self._tester.answer(self._change.call_async(request)).success

    def do(self, *transitions):
        for transition in transitions:
            assert self.change(IDS[transition]), transition

    @property
    def state(self):
        return self._tester.answer(self._get.call_async(GetState.Request())).current_state.label

    def close(self):
        for client in (self._change, self._get):
            self._tester.destroy_client(client)


@pytest.fixture
def manage(start, tester):
    """Start a node that waits for its manager; return node and manager."""
    managers = []

    def run(name, environment=(), **parameters):
        process = start(f'nodes.{name}', parameters={'autostart': 'false', **parameters},
                        **dict(environment))
        managers.append(Manager(tester, name))
        return process, managers[-1]
    yield run
    for manager in managers:
        manager.close()


@pytest.mark.full
@pytest.mark.parametrize('state', [*WAY_TO, 'finalized'])
@pytest.mark.parametrize('name', ['detector', 'relocalizer'])
def test_sigterm_ends_a_node_in_every_state(manage, room_map, name, state):
    process, manager = manage(name, **(class_matching(room_map) if name == 'relocalizer' else
                                       {'model': PROJECT / 'demo/assets/yolo.onnx'}))
    if state == 'finalized':
        assert manager.change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    else:
        manager.do(*WAY_TO[state])
    assert manager.state == state
    code, seconds = process.stop(signal.SIGTERM)
    assert code == 0, process.output()
    assert seconds < 2.0
    assert 'Traceback' not in process.output()


def test_only_an_active_relocalizer_localizes(manage, tester, room_map):
    """A label of a megabyte is refused; deactivation answers the request that waits."""
    process, manager = manage('relocalizer', **class_matching(room_map))
    tester.connect()
    assert not tester.answer(tester.ask()).success
    assert not manager.change(IDS['configure'], 'x' * 1_000_000)
    assert manager.change(IDS['configure'], 'configure') and manager.state == 'inactive'
    assert not tester.answer(tester.ask()).success and tester.listened_to() == 0
    manager.do('activate')
    assert tester.relocalize(make_frame()).success
    tester.wait(lambda: tester.listened_to() == 0, 'the end of the subscriptions')
    future = tester.ask()
    tester.wait(lambda: tester.listened_to() == 3, 'the relocalizer to subscribe')
    manager.do('deactivate')
    answer = tester.answer(future)
    assert not answer.success and answer.message.startswith('the node was ')
    tester.wait(lambda: tester.listened_to() == 0, 'the subscriptions to end')
    tester.answer(tester.ask_reinitialize())
    assert not tester.answer(tester.ask()).success
    assert process.stop()[0] == 0
    assert max(map(len, process.output().splitlines())) < 2000


def test_the_manager_hears_by_a_bond_whether_a_node_lives(manage, tester, room_map):
    """The bond uses the topic and name that Nav2's manager expects; bondpy is a stand-in."""
    heard = []
    tester.create_subscription(KeyValue, '/bond', heard.append, 10)
    path = f'{PROJECT / "test/nodes/stand_ins"}:{os.environ.get("PYTHONPATH", "")}'
    process, manager = manage('relocalizer', environment={'PYTHONPATH': path},
                              **class_matching(room_map))
    for _ in range(2):
        manager.do('configure', 'activate')
        tester.wait(lambda: KeyValue(key='relocalizer', value='alive') in heard, 'its heartbeat')
        manager.do('deactivate', 'cleanup')
        tester.wait(lambda: KeyValue(key='relocalizer', value='dead') in heard, 'its end')
        heard.clear()
    manager.do('configure', 'activate')
    tester.wait(lambda: KeyValue(key='relocalizer', value='alive') in heard, 'its heartbeat')
    tester.ask()  # which waits for frames
    process.send(signal.SIGTERM)
    begun_at = time.monotonic()
    tester.wait(lambda: KeyValue(key='relocalizer', value='dead') in heard, 'its last word')
    assert time.monotonic() - begun_at < 1.0, 'the manager misses its heartbeat after 4 s'
    assert process.stop(signal.SIGTERM)[0] == 0
    assert 'Traceback' not in process.output()
