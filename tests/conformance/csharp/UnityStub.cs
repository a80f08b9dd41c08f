// The names of UnityEngine that docs/howto/csharp-client.md uses: its script is compiled where there is no Unity.
namespace UnityEngine
{
    public class Object { }
    public class Component : Object { public T GetComponent<T>() { return default(T); } }
    public class MonoBehaviour : Component { }
    public class Transform : Component { public Vector3 position; public Quaternion rotation; }
    public class Rigidbody : Component { public Vector3 velocity; }
    public struct Vector3 { public float x, y, z; }
    public struct Quaternion
    {
        public float w, x, y, z;
        public Quaternion normalized { get { return this; } }
    }
    public static class Physics
    {
        public static bool autoSimulation;
        public static void Simulate(float step) { }
    }
    public static class Debug { public static void Log(object message) { } }
}
