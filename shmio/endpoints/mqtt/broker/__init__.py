"""The broker that the instance starts itself: mosquitto, or aMQTT for development."""
