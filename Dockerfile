# pnv_ros in a ROS 2 Jazzy workspace. docker build -t pnv_ros . && docker run --net=host --shm-size=512m pnv_ros
FROM ros:jazzy

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends python3-venv && rm -rf /var/lib/apt/lists/*

WORKDIR /ws
COPY . src/pnv_ros
RUN python3 -m venv --system-site-packages .venv && touch .venv/COLCON_IGNORE && \
    .venv/bin/pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu -r src/pnv_ros/requirements.txt && \
    source /opt/ros/jazzy/setup.bash && .venv/bin/python "$(command -v colcon)" build --packages-select pnv_ros

ENTRYPOINT ["/bin/bash", "-c", "source install/setup.bash && exec ros2 run pnv_ros place_recognizer \"$@\"", "--"]
