# docker build -t adxl_ros . && docker run --rm -it --device /dev/ttyACM0 adxl_ros
ARG ROS_DISTRO=jazzy
FROM ros:${ROS_DISTRO}-ros-base AS dependencies
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /ws
COPY package.xml src/adxl_ros/
COPY requirements src/adxl_ros/requirements
# hadolint ignore=DL3008
RUN apt-get update && rosdep update --rosdistro "$ROS_DISTRO" \
    && rosdep install --from-paths src --ignore-src -y \
    && apt-get install -y --no-install-recommends libiio0 make python3-pip python3-venv \
    && rm -rf /var/lib/apt/lists/* \
    && python3 -m pip install --no-cache-dir --break-system-packages \
        -r src/adxl_ros/requirements/extras.txt

FROM dependencies AS package
COPY . src/adxl_ros
RUN source "/opt/ros/$ROS_DISTRO/setup.bash" && colcon build
RUN sed -i 's#^exec#source /ws/install/setup.bash --\nexec#' /ros_entrypoint.sh
CMD ["ros2", "launch", "adxl_ros", "robot.launch.py", "-s"]
