"""The connector mtconnect for shmio, which reads machine tools by MTConnect."""
