"""The connector ``mqtt``: reads what devices publish at a broker, and publishes commands to them.

A register gets its value from the text of a topic's messages, from a value in their JSON, or from a
metric of Sparkplug B. A thread receives the messages, and keeps the newest message of each topic.
:meth:`MqttConnector.read` makes an image of these without waiting for the network.
"""
