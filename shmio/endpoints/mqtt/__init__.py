"""The MQTT endpoint: a bridge to a broker, and the instance's own broker if there is no other.

``bridge`` runs everything in one thread:

- ``feed`` follows one block, and marks the topics that have changed; ``topics`` has the rules of
  topics, and makes their payloads.
- ``outbox`` queues topics and results for the broker, and keeps changes during an outage.
- ``connection`` connects to the broker. ``topic_guard`` corrects what other clients publish on the
  bridge's topics.
- ``commands`` receives commands from the broker, and sends them to their sources.
- ``steps`` delivers the steps of virtual time; ``sparkplug`` publishes the same sources as
  Sparkplug B.

In the comments of this package, "we" and "our" mean this instance, as opposed to the broker and its
other clients.
"""
