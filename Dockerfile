# ROS 2 Jazzy with lidar_perception on the CPU.
#   docker build -t lidar_perception .
#   docker run --rm -it --shm-size=1g --net=host lidar_perception \
#       ros2 launch lidar_perception fused.launch.py points:=/velodyne_points tracking:=true
FROM ros:jazzy-ros-base

RUN apt-get update && apt-get install -y --no-install-recommends \
        python3-venv ros-jazzy-vision-msgs ros-jazzy-tf2-msgs && \
    rm -rf /var/lib/apt/lists/*

# ROS and apt's Python packages are built for NumPy 1.26.
RUN python3 -m venv --system-site-packages /opt/lidar && \
    /opt/lidar/bin/pip install --no-cache-dir torch --index-url https://download.pytorch.org/whl/cpu

COPY . /src
RUN /opt/lidar/bin/pip install --no-cache-dir /src 'numpy<2'

ENV PATH=/opt/lidar/bin:$PATH \
    PYTHONPATH=/opt/lidar/lib/python3.12/site-packages
RUN sed -i '$ i export AMENT_PREFIX_PATH=/opt/lidar:$AMENT_PREFIX_PATH' /ros_entrypoint.sh && \
    sed -i '$ i export PYTHONPATH=/opt/lidar/lib/python3.12/site-packages:$PYTHONPATH' /ros_entrypoint.sh

CMD ["lidar-perception", "--help"]
