"""Reader of rosbag2's SQLite files (.db3) of all ROS 2 distributions, including incomplete ones."""

from __future__ import annotations

import sqlite3
from collections.abc import Collection
from pathlib import Path

from lidar_perception.data.storage import Stream, Topic

MAGIC = b"SQLite format 3\0"
REQUIRED_COLUMNS = {"topics": {"id", "name", "type"}, "messages": {"topic_id", "timestamp", "data"}}


class SqliteFile:
    """A database open for reading, see StorageFile.

    The file and its folder may be read-only; nothing is written. Raises ValueError or sqlite3.Error
    if it is damaged.
    """

    def __init__(self, path: Path):
        # rosbags opens all files as immutable and so misses messages that are only in the -wal
        # file (rosbags/rosbag2/storage_sqlite3.py, Sqlite3Reader.open). In exclusive mode SQLite
        # reads that file without a -shm file; without locks this works in read-only folders.
        logs = (path.with_name(path.name + end) for end in ("-wal", "-journal"))
        has_log = any(log.is_file() and log.stat().st_size for log in logs)
        options = "mode=ro&vfs=unix-none" if has_log else "immutable=1"
        self.database = sqlite3.connect(f"{path.absolute().as_uri()}?{options}", uri=True, check_same_thread=False)
        try:
            self.database.execute("PRAGMA locking_mode=EXCLUSIVE")
            self._read_topics()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self.database.close()

    def read_messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (topic id, time, data) of topics with start <= time < stop, in order of time."""
        for topic, time, data in self.database.execute(
            f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN "
            f"({', '.join('?' * len(ids))}) AND timestamp >= ? AND timestamp < ? "
            "ORDER BY timestamp, rowid",
            (*ids, start, stop),
        ):
            if not isinstance(data, bytes) or not isinstance(time, int):
                raise ValueError(
                    f"corrupt row: data of type {type(data).__name__} and timestamp {time!r}; "
                    "expected bytes and an integer"
                )
            yield topic, time, data

    def _read_topics(self) -> None:
        columns = {
            table: {row[1] for row in self.database.execute(f"PRAGMA table_info({table})")}
            for table in REQUIRED_COLUMNS
        }
        if any(REQUIRED_COLUMNS[table] - columns[table] for table in REQUIRED_COLUMNS):
            raise ValueError("the tables 'topics' or 'messages' are missing or incomplete")
        # The first distributions stored neither encoding nor QoS.
        encoding, qos = (
            name if name in columns["topics"] else "''" for name in ("serialization_format", "offered_qos_profiles")
        )
        spans = {
            topic: (count, first, last)
            for topic, count, first, last in self.database.execute(
                "SELECT topic_id, COUNT(*), MIN(timestamp), MAX(timestamp) FROM messages GROUP BY topic_id"
            )
        }
        rows = self.database.execute(f"SELECT id, name, type, {encoding}, {qos} FROM topics ORDER BY id")
        self.topics = [
            Topic(topic_id, name, type_name, encoding, qos, spans.get(topic_id, (0,))[0])
            for topic_id, name, type_name, encoding, qos in rows
        ]
        topic_spans = [spans[topic.id] for topic in self.topics if topic.id in spans]
        self.times = (
            (min(first for _, first, _ in topic_spans), max(last for *_, last in topic_spans)) if topic_spans else None
        )
