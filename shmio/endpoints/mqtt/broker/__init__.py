"""The broker that the instance starts itself: mosquitto, or aMQTT where it is missing."""
