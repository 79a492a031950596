"""The connector mtconnect for shmio: machine tools by MTConnect."""
