"""uniground for ROS 2: `convert` makes messages of answers, `node` asks and publishes."""
