# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Access: without credentials nobody gets in."""

from pathlib import Path
import shutil
import subprocess
import time

from graph import Graph
from graph_page import OPERATOR, POLICY
import pytest
from std_srvs.srv import Trigger


def enforced(keystore: Path) -> dict[str, str]:
    return {
        'ROS_SECURITY_ENABLE': 'true',
        'ROS_SECURITY_STRATEGY': 'Enforce',
        'ROS_SECURITY_KEYSTORE': str(keystore),
    }


def test_a_middleware_without_security_does_not_start_where_it_is_enforced(tmp_path):
    (tmp_path / 'enclaves').mkdir()
    with Graph() as g:
        node = g.start('stage', wait=False, env=enforced(tmp_path))
        # with the libraries it is the missing enclave that ends it
        assert node.process.wait(60) != 0
        assert 'security' in node.log.lower()


@pytest.mark.skipif(
    shutil.which('ros2') is None, reason='no ros2 here: SROS2 comes with the packages of Jazzy'
)
def test_without_credentials_nobody_commands_or_calls(tmp_path):
    def ros2(*arguments: object) -> None:
        command = ['ros2', 'security', *map(str, arguments)]
        subprocess.run(command, check=True, env=environment, timeout=60)

    with Graph() as g:
        # permissions hold for one domain
        environment, keystore = g.environment, tmp_path / 'keystore'
        ros2('create_keystore', keystore)
        for node in ('stage', 'excitation', OPERATOR):
            ros2('create_enclave', keystore, f'/piezo_ident/{node}')
            ros2('create_permission', keystore, f'/piezo_ident/{node}', POLICY)
        for node in ('stage', 'excitation'):
            enclave = {'ROS_SECURITY_ENCLAVE_OVERRIDE': f'/piezo_ident/{node}'}
            handle = g.start(node, wait=False, env={**enforced(keystore), **enclave})
            handle.is_ended = False
        client = g.node.create_client(Trigger, '/excitation/start')
        g.publish_text('model', 'nobody listens')
        end = time.monotonic() + 15.0
        while time.monotonic() < end:
            assert not client.service_is_ready() and not g.node.count_subscribers('/voltage')
            time.sleep(0.01)
        assert all(h.process.poll() is None for h in g.handles)
