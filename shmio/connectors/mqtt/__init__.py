"""The connector ``mqtt``: reads what devices publish at a broker, and publishes commands.

A register is the text of a topic, a value in its JSON, or a metric of Sparkplug B. A thread receives
and keeps the newest message of each topic; :meth:`MqttConnector.read` makes an image of them without
waiting for the network.
"""
