# SPDX-License-Identifier: Apache-2.0
"""A DDS participant that publishes types of no ROS package until it is killed.

`python odd_participant.py a=foo::bar::X` publishes `foo::bar::dds_::X_` on /a. The
middleware derives the name from the type support of a message, where it is replaced
here.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time

import rclpy
from std_msgs.msg import String

_KEPT = []  # names that the middleware reads, kept alive
_LIBRARY = 'libstd_msgs__rosidl_typesupport_fastrtps_c.so'
_HANDLE = 'rosidl_typesupport_fastrtps_c__get_message_type_support_handle__std_msgs__msg__String'


class TypeSupport(ctypes.Structure):
    """First fields of rosidl_message_type_support_t."""

    _fields_ = (
        ('identifier', ctypes.c_char_p),
        ('data', ctypes.POINTER(ctypes.c_char_p)),  # begins with namespace and name
    )


def rename(namespace, name):
    """Rename std_msgs/String in this process."""
    String.__class__.__import_type_support__()  # loads its libraries
    handle = getattr(ctypes.CDLL(_LIBRARY), _HANDLE)
    handle.restype = ctypes.POINTER(TypeSupport)
    names = handle().contents.data
    _KEPT.extend((namespace, name))
    names[0], names[1] = namespace, name


if __name__ == '__main__':
    rclpy.init(args=[])
    node = rclpy.create_node('odd', start_parameter_services=False, enable_rosout=False)
    publishers = []
    for argument in sys.argv[1:]:
        topic, names = argument.split('=')
        namespace, _, name = names.rpartition('::')
        rename(os.fsencode(namespace), os.fsencode(name))
        publishers.append(node.create_publisher(String, topic, 10))
    print('ready', flush=True)  # noqa: T201
    while True:
        for publisher in publishers:
            publisher.publish(String(data='x'))
        time.sleep(0.05)
