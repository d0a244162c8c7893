"""ROS 2 without ROS for ibrobot: messages to and from CDR, message definitions, type hashes."""
