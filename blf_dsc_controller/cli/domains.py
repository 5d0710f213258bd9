# SPDX-License-Identifier: Apache-2.0
"""Free ROS domains: those without other participants on this computer.

Runs of this package claim their domain by the name of a socket. Any other participant
shows in the UDP ports that the protocol assigns to its domain (DDSI-RTPS 2.5, 9.6.2.3),
whatever its node is called and whether or not it has one.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from blf_dsc_controller.errors import BlfDscError

DOMAINS = range(1, 101)  # 0 is the default; above 101, ports are ephemeral
_LOOPBACK = '127.0.0.1'
_DISCARD = 9  # port whose messages nobody takes (RFC 863)
_FIRST_PORT = 7400  # of domain 0
_PORTS = 250  # of a domain
_TABLES = ('udp', 'udp6')  # sockets of this network, of all users
_LOCAL_ADDRESS, _INODE = 1, 9  # columns of a table


@contextmanager
def own_domain(avoided: Collection[int] = ()) -> Iterator[int]:
    """Claim a ROS domain without any other participant.

    It is none of the `avoided`, and not the domain of this shell. Processes that
    inherit open files hold the claim as well, as the nodes of a run that was killed do.

    Raises:
        BlfDscError: none is free.
    """
    first = os.getpid() % len(DOMAINS)
    for domain in (*DOMAINS[first:], *DOMAINS[:first]):
        if domain in avoided or domain == shell_domain():
            continue
        claim = claimed(domain)
        if claim is None:
            continue
        with closing(claim):
            if not strangers(domain):
                yield domain
                return
    raise BlfDscError(
        f'no ROS domain is free: runs or other nodes are in each of {DOMAINS[0]} to '
        f'{DOMAINS[-1]} on this computer, or it is the ROS_DOMAIN_ID of this shell; '
        'end some of them'
    )


def check_network() -> None:
    """Raise BlfDscError if nodes of this computer cannot reach each other.

    They would wait for each other for ever, as in a container without any interface.
    """
    if sys.platform != 'linux':
        raise BlfDscError(
            'a run over ROS 2 keeps to a free domain, which is found on Linux only: run with '
            '--offline, or start the nodes by `ros2 run`'
        )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.sendto(b'', (_LOOPBACK, _DISCARD))
        except OSError as error:
            raise BlfDscError(
                f'the processes of a run talk over {_LOOPBACK}, which cannot be reached '
                f'({error.strerror}): bring the loopback interface up (`ip link set lo up`), '
                'or run with --offline'
            ) from error


def shell_domain() -> int:
    """Return the domain that nodes started from this shell would enter."""
    with suppress(ValueError):
        return int(os.environ.get('ROS_DOMAIN_ID') or 0)
    return 0


def claimed(domain: int) -> socket.socket | None:
    """Return the claim of a domain, held until it is closed; None if another process has it."""
    claim = socket.socket(socket.AF_UNIX)
    claim.set_inheritable(True)
    try:
        claim.bind(f'\0blf_dsc_controller domain {domain}')
    except OSError:
        claim.close()
        return None
    return claim


def strangers(domain: int) -> list[int]:
    """Return the UDP ports of a domain that other processes here have bound."""
    own = _own_sockets()
    return [port for port, inode in bound_ports(domain) if inode not in own]


def bound_ports(domain: int) -> list[tuple[int, str]]:
    """Return the UDP ports of a domain that are bound here, with the numbers of their sockets."""
    begin = _FIRST_PORT + _PORTS * domain
    ports = range(begin, begin + _PORTS)
    return [each for each in _all_bound_ports() if each[0] in ports]


def _all_bound_ports() -> Iterator[tuple[int, str]]:
    """Yield each bound UDP port with the number of its socket."""
    for table in _TABLES:
        path = Path('/proc/net') / table
        if not path.exists():  # IPv6 may be off
            continue
        for line in path.read_text(encoding='ascii').splitlines()[1:]:
            columns = line.split()
            _, _, port = columns[_LOCAL_ADDRESS].rpartition(':')
            yield int(port, 16), columns[_INODE]


def _own_sockets() -> set[str]:
    """Return the numbers of the sockets of this process."""
    found = set()
    for each in Path('/proc/self/fd').iterdir():
        with suppress(OSError):  # closed meanwhile
            kind, _, number = str(each.readlink()).partition(':')
            if kind == 'socket':
                found.add(number.strip('[]'))
    return found
