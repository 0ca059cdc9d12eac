"""The fleet's memory: places of several robots and many days in a vector database (Milvus), beside the recogniser.

    places   a keyframe as a row, and what is believed of a row that comes back
    store    the one collection of a model in Milvus or Milvus Lite
    outbox   keyframes on disk until the store has them
    answers  a query judged against the fleet's places, by the judge of local candidates
    fleet    the threads: keep, ask, send; recognition never waits for them
    maps     saved maps go up and selections come down

Needs the extra `fleet` (pymilvus, milvus-lite), imported when a store is opened. No ROS.
"""
