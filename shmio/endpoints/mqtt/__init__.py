"""The MQTT endpoint: a bridge to a broker, and a broker of the instance where there is no other.

``bridge`` runs everything in one thread:

- ``feed`` follows one block and marks the topics that changed; ``topics`` has the rules of topics,
  and makes their payloads.
- ``outbox`` queues topics and results for the broker, and keeps changes during an outage.
- ``connection`` connects to the broker; ``topic_guard`` corrects what others publish on our topics.
- ``commands`` receives commands from the broker, and sends them to their sources.
- ``steps`` delivers the steps of virtual time; ``sparkplug`` publishes the same sources as
  Sparkplug B.

"Our" topics, connections and so on are those of this instance.
"""
