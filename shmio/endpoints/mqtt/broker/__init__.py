"""The broker that the instance itself runs: mosquitto, or aMQTT for development."""
