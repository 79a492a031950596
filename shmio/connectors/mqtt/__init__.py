"""The connector ``mqtt``: reads what devices publish at a broker, and publishes commands to them.

A register is the payload of a topic as text, a value in a topic's JSON, or a metric of Sparkplug B.
A thread receives messages and keeps the newest of each topic. :meth:`MqttConnector.read` makes an
image of them without waiting for the network.
"""
