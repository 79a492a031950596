"""The broker that the instance runs itself: mosquitto, or aMQTT for development."""
