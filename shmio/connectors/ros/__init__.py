"""The connectors ``rosbridge`` and ``ros2``: read the topics of robots, and publish commands.

Both connectors share these modules: ``messages.py`` has the message types, ``addresses.py`` finds the
fields that addresses name, ``values.py`` converts their values to those of registers, ``topics.py``
turns messages into images, and ``commands.py`` turns writes into messages. ``rosbridge.py``,
``websocket.py`` and ``connection.py`` speak the rosbridge protocol; ``dds.py``, ``participant.py``,
``dds_types.py`` and ``cdr.py`` speak DDS as ROS 2 does.
"""
