# SPDX-License-Identifier: Apache-2.0
"""A DDS participant that publishes types of no ROS package until it is killed.

`python odd_participant.py a=foo::bar::X` publishes `foo::bar::dds_::X_` on /a. The middleware
derives the name from the type support of a message, where it is replaced here.
"""

from __future__ import annotations

import ctypes
import os
import sys
import time

import rclpy
from std_msgs.msg import String

_KEPT = []  # names that the middleware reads, kept alive
_IDENTIFIER = b'rosidl_typesupport_fastrtps_c'
_get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
_get_pointer.restype, _get_pointer.argtypes = ctypes.c_void_p, (ctypes.py_object, ctypes.c_char_p)
_get_name = ctypes.pythonapi.PyCapsule_GetName
_get_name.restype, _get_name.argtypes = ctypes.c_char_p, (ctypes.py_object,)


class TypeSupport(ctypes.Structure):
    """First fields of rosidl_message_type_support_t."""


TypeSupport._fields_ = (
    ('identifier', ctypes.c_char_p),
    ('data', ctypes.POINTER(ctypes.c_char_p)),  # begins with namespace and name
    (
        'find',
        ctypes.CFUNCTYPE(ctypes.POINTER(TypeSupport), ctypes.POINTER(TypeSupport), ctypes.c_char_p),
    ),
)


def rename(namespace, name):
    """Rename std_msgs/String in this process."""
    String.__class__.__import_type_support__()
    capsule = String.__class__._TYPE_SUPPORT
    found = ctypes.cast(_get_pointer(capsule, _get_name(capsule)), ctypes.POINTER(TypeSupport))
    names = found.contents.find(found, _IDENTIFIER).contents.data
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
