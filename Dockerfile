# SPDX-License-Identifier: Apache-2.0
# ROS 2 Jazzy with what the package and its tests need: `docker build --tag blf_dsc_controller .`
FROM ros:jazzy-ros-base

RUN apt-get update && apt-get install --yes --no-install-recommends python3-pip python3-venv \
    && rm -rf /var/lib/apt/lists/*

# ROS's messages were compiled against Ubuntu's numpy, with which pyarrow 26 does not load, and
# colcon installs by an older setuptools.
ENV PIP_BREAK_SYSTEM_PACKAGES=1
RUN python3 -c 'import numpy; print(f"numpy=={numpy.__version__}\npyarrow<26\nsetuptools<80")' > /constraints.txt

WORKDIR /ws/src/blf_dsc_controller
COPY . .
# Not over Debian's packages but beside them; the package itself is installed by colcon.
RUN pip install --no-cache-dir --ignore-installed --constraint /constraints.txt '.[test]' \
    && pip uninstall --yes blf_dsc_controller && rm -rf build *.egg-info
# Compiled kernels become part of what colcon installs: the first start takes seconds, not half a minute.
RUN for preset in recommended panda; do \
    python3 -m blf_dsc_controller doctor --compile package --config $preset || exit 1; done
