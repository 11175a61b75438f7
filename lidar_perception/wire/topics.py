"""Topic names shared by bags, nodes and launch files."""

POINTS = "/points"
TRUTH = "/ground_truth/detections"
TRUTH_3D = "/ground_truth/detections_3d"  # the same labels as Detection3DArray, optional
CAMERA_INFO = "/camera/camera_info"
EXTRINSICS = "/camera/extrinsics"  # geometry_msgs/TransformStamped, pose of the camera in the LiDAR frame
IMAGE = "/camera/image/compressed"
TF, TF_STATIC = "/tf", "/tf_static"
ODOMETRY = "/odom"  # usual topic of nav_msgs/Odometry
CLICK = "/clicked_point"  # topic that RViz and Foxglove publish
DETECTIONS, TRACKS = "/output/detections", "/output/tracks"  # suffixes of the topics of a node

ODOMETRY_FRAME = "odom"  # fixed frame, REP-105
LIDAR_FRAME = "velodyne"
CAMERA_FRAME = "camera_optical"  # optical frame (z forward), REP-103

SEMANTIC, INSTANCE = "semantic", "instance"  # columns of a labelled cloud, as in SemanticKITTI
